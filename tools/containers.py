"""Containers without Docker: a service of a compose file in namespaces of its own, on an overlay over an image's files.

Needs root, in a mount, network and process namespace of its own: everything made here ends with those.
"""

from __future__ import annotations

import json
import logging
import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from service.base.errors import TandemError
from tools.compose_services import Service

PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
"""Of images that have no other."""
BRIDGE, NETWORK = "tandem0", "10.77.0"
NAMES_ADDRESS = f"{NETWORK}.1"
"""Where names are answered; also the way out, which leads nowhere."""
MEMORY = Path("/sys/fs/cgroup/memory")
"""Groups with a memory limit, where the machine has version 1 of them."""
INIT = Path("/usr/bin/tini-static")
"""What Docker calls docker-init."""
NODES = {"null": "1 3", "zero": "1 5", "full": "1 7", "random": "1 8", "urandom": "1 9", "tty": "5 0"}
STREAMS = ("in", "out", "err")
HEALTH_S = 5.0
RESTART_S = 1.0
GONE_S = 20.0
_log = logging.getLogger("deployed")


@dataclass(frozen=True, slots=True)
class Image:
    """The files of an image, and what it says about running them."""

    root: Path
    user: str = "0:0"
    entrypoint: Sequence[str] = ()
    command: Sequence[str] = ()
    environment: Mapping[str, str] = field(default_factory=lambda: {"PATH": PATH})
    directory: str = "/"


class Container:
    """One container of a service; it keeps its address and its files when it is started again.

    Args:
        service: what to run.
        image: its image.
        name: such as ``worker-2``.
        address: in the network of all containers.
        home: directory for its files, its log, and the volumes of all.
    """

    def __init__(self, service: Service, image: Image, name: str, address: str, home: Path) -> None:
        self.service, self.name, self.address = service, name, address
        self._image, self._home = image, home
        self._root = home / "containers" / name / "root"
        self._process: subprocess.Popen[bytes] | None = None
        self._forwards: list[subprocess.Popen[bytes]] = []
        self.wanted = False
        """Whether it is started again when it ends."""
        self.num_starts = 0

    @property
    def _link(self) -> str:
        """The machine's end of its network."""
        return f"v{self.address.rpartition('.')[2]}"

    @property
    def log(self) -> Path:
        """What it wrote to its standard output and error."""
        return self._home / "logs" / f"{self.name}.log"

    @property
    def pid(self) -> int:
        """The first process inside."""
        if self._process is not None:
            children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
            with suppress(OSError):
                if first := children.read_text().split():
                    return int(first[0])
        raise TandemError(f"{self.name} does not run; its log is {self.log}")

    @property
    def runs(self) -> bool:
        """Whether its first process is there."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Make its network, mount its files, and start its program."""
        number, link = int(self.address.rpartition(".")[2]), self._link
        for command in (
            f"netns add {self.name}",
            # The same hardware address each time, as with Docker: others remember it for a while.
            f"link add {link} type veth peer name eth0 address 02:42:0a:4d:00:{number:02x} netns {self.name}",
            f"link set {link} master {BRIDGE} up",
            f"-n {self.name} addr add {self.address}/24 dev eth0",
            f"-n {self.name} link set lo up",
            f"-n {self.name} link set eth0 up",
            f"-n {self.name} route add default via {NAMES_ADDRESS}",
        ):
            run(["ip", *command.split()])
        for part in ("root", "files", "work"):
            (self._root.parent / part).mkdir(parents=True, exist_ok=True)
        script = self._root.parent / "start.sh"
        script.write_text("\n".join(self._script()) + "\n")
        script.chmod(0o600)  # it has the secrets
        spaces = ["unshare", "--mount", "--pid", "--ipc", "--uts", "--fork", "--kill-child"]
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                ["nsenter", f"--net=/run/netns/{self.name}", *spaces, "/bin/sh", "-eu", str(script)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.wanted = True
        self.num_starts += 1
        for port in self.service.ports:
            listen = f"TCP-LISTEN:{port.outside},bind={port.address},fork,reuseaddr"
            self._forwards.append(
                subprocess.Popen(["socat", listen, f"TCP:{self.address}:{port.inside}"], stderr=subprocess.DEVNULL)
            )

    def stop(self) -> bool:
        """End it with SIGTERM, and after its grace with SIGKILL; True if SIGTERM was enough."""
        self.wanted = False
        if not self.runs:
            self.clear()
            return True
        assert self._process is not None
        with suppress(TandemError, ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
        try:
            self._process.wait(self.service.stop_grace_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return False
        finally:
            self.clear()
        return True

    def kill(self) -> None:
        """Kill everything in it at once, as when its machine is lost."""
        assert self._process is not None
        with suppress(TandemError, ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self._process.wait()

    def clear(self) -> None:
        """Take its network away; its files stay."""
        for each in self._forwards:
            each.kill()
            each.wait()
        self._forwards.clear()
        if Path(f"/run/netns/{self.name}").exists():
            run(["ip", "link", "delete", self._link], check=False)  # or it would stay for a moment after its namespace
            run(["ip", "netns", "delete", self.name])

    def is_healthy(self) -> bool:
        """Whether its health check succeeds; without one, whether it runs."""
        if not self.runs:
            return False
        if self.service.health is None:
            return True
        try:
            return self.run(self.service.health, timeout_s=HEALTH_S, check=False).returncode == 0
        except (subprocess.TimeoutExpired, TandemError):
            return False

    def run(
        self, command: Sequence[str], *, timeout_s: float = 600.0, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in it as ``docker compose exec`` does."""
        spaces = ["nsenter", f"--target={self.pid}", "--mount", "--uts", "--ipc", "--net", "--pid", "--root"]
        return run([*spaces, *self._inside(), *command], timeout_s=timeout_s, check=check)

    def status(self) -> dict[str, str]:
        """What the kernel says about its program: ``/proc/PID/status``."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text().split()
        text = Path(f"/proc/{children[0]}/status").read_text()
        return {key: value.strip() for key, _, value in (line.partition(":") for line in text.splitlines())}

    def _script(self) -> list[str]:
        """The lines that mount its files, and become its program."""
        service, root, here = self.service, self._root, self._root.parent
        lines = [f"hostname {self.name}"]
        if service.memory_bytes is not None and MEMORY.is_dir():
            group = MEMORY / f"tandem-deployed-{self.name}"
            lines += [f"mkdir -p {group}", f"echo {service.memory_bytes} > {group}/memory.limit_in_bytes"]
            lines += [f"echo 0 > {group}/cgroup.procs"]
        layers = f"lowerdir={self._image.root},upperdir={here / 'files'},workdir={here / 'work'}"
        lines += [
            f"mount -t overlay overlay -o {layers} {root}",
            f"mount -t proc -o nosuid,nodev,noexec proc {root}/proc",
            f"mount -t sysfs -o ro,nosuid,nodev,noexec sysfs {root}/sys",
            f"mount -t tmpfs -o mode=755,nosuid tmpfs {root}/dev",
            *(f"mknod -m 666 {root}/dev/{name} c {numbers}" for name, numbers in NODES.items()),
            f"mkdir -p {root}/dev/shm {root}/dev/pts {root}/run/secrets",
            f"mount -t tmpfs -o mode=1777,nosuid,nodev,noexec,size={service.shm_bytes} shm {root}/dev/shm",
            f"mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts {root}/dev/pts",
            f"ln -sf pts/ptmx {root}/dev/ptmx",
            *(f"ln -sf /proc/self/fd/{number} {root}/dev/std{name}" for number, name in enumerate(STREAMS)),
            f"ln -sf /proc/self/fd {root}/dev/fd",
            f"echo nameserver {NAMES_ADDRESS} > {root}/etc/resolv.conf",
            f"printf '127.0.0.1 localhost\\n{self.address} {self.name}\\n' > {root}/etc/hosts",
        ]
        if service.memory_bytes is not None and MEMORY.is_dir():
            lines += [
                f"mount -t tmpfs tmpfs {root}/sys/fs/cgroup",
                f"mkdir {root}/sys/fs/cgroup/memory",
                f"mount --bind -o ro {MEMORY}/tandem-deployed-{self.name} {root}/sys/fs/cgroup/memory",
            ]
        lines += [f"install -m 755 {INIT} {root}/sbin/docker-init"]
        for name, value in service.secrets.items():
            place = f"{root}/run/secrets/{name}"
            lines += [f"printf %s {shlex.quote(value)} > {place}", f"chmod 444 {place}"]
        for mount in service.mounts:
            lines += self._mount(mount.source, mount.target, "ro" if mount.read_only else "rw")
        lines += [f"mount -t tmpfs -o mode=1777,nosuid,nodev,noexec tmpfs {root}{place}" for place in service.tmpfs]
        if service.read_only:
            lines += [f"mount -o remount,ro {root}"]
        command = ["/sbin/docker-init", "--", *self._command()]
        return [*lines, "exec " + shlex.join(["chroot", str(root), *self._inside(), *command])]

    def _mount(self, source: Path | str, target: str, mode: str) -> list[str]:
        """The lines that mount a path; a volume that is new gets what the image has there, as with Docker."""
        inside = self._image.root / target.lstrip("/")
        if isinstance(source, str):
            volume = self._home / "volumes" / source
            if not volume.exists():
                volume.mkdir(parents=True)
                if inside.is_dir():
                    run(["cp", "-a", f"{inside}/.", str(volume)])
                    run(["chown", f"--reference={inside}", str(volume)])
            source = volume
        place = self._root / target.lstrip("/")
        make = f"mkdir -p {place}" if source.is_dir() else f"mkdir -p {place.parent} && touch {place}"
        return [make, f"mount --bind {source} {place}", f"mount -o remount,bind,{mode} {place}"]

    def _command(self) -> list[str]:
        """As with Docker, an entrypoint in place of the image's takes away the image's command."""
        service, image = self.service, self._image
        if service.entrypoint is not None:
            return [*service.entrypoint, *(service.command or ())]
        return [*image.entrypoint, *(image.command if service.command is None else service.command)]

    def _inside(self) -> list[str]:
        """The words before a command that give it the container's environment, directory, user and rights."""
        user, group, home = _account(self.service.user or self._image.user, self._image.root)
        variables = {"HOME": home, "HOSTNAME": self.name, **self._image.environment, **self.service.environment}
        rights = ["--bounding-set=-all", "--inh-caps=-all", "--no-new-privs"]
        return [
            *("env", "-i", "-C", self._image.directory, *(f"{key}={value}" for key, value in variables.items())),
            *("setpriv", f"--reuid={user}", f"--regid={group}", "--clear-groups", *rights),
        ]


class Containers:
    """All containers of one machine, the names they find each other by, and what starts them again.

    Args:
        home: directory for everything that they write.
        images: by the names that the compose file has for them, without tags.
    """

    def __init__(self, home: Path, images: Mapping[str, Image]) -> None:
        self._home, self._images = home, images
        self._all: dict[str, Container] = {}
        self._lock = threading.RLock()
        run(["mount", "-t", "tmpfs", "tmpfs", "/run/netns"])
        for words in ("set lo up", f"add {BRIDGE} type bridge", f"set {BRIDGE} up"):
            run(["ip", "link", *words.split()])
        run(["ip", "addr", "add", f"{NAMES_ADDRESS}/24", "dev", BRIDGE])
        self._names = home / "names"
        self._names.write_text("")
        answers = [f"--addn-hosts={self._names}", "--no-hosts", "--no-resolv", "--local=//"]
        place = [f"--listen-address={NAMES_ADDRESS}", "--bind-interfaces", "--conf-file=/dev/null", "--pid-file"]
        command = ["dnsmasq", "--keep-in-foreground", "--user=root", *answers, *place]
        self._dns = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        threading.Thread(target=self._watch, daemon=True).start()

    def __getitem__(self, name: str) -> Container:
        return self._all[name]

    def all(self) -> list[Container]:
        """Every container that was ever started, in the order of their first starts."""
        return list(self._all.values())

    def start(self, service: Service, *, number: int = 1) -> Container:
        """Start a container of a service, or one that was stopped."""
        name = f"{service.name}-{number}"
        with self._lock:
            if name not in self._all:
                address = f"{NETWORK}.{10 + len(self._all)}"
                image = self._images[service.image.rpartition(":")[0]]
                self._all[name] = Container(service, image, name, address, self._home)
            self._all[name].start()
            self._tell_names()
            return self._all[name]

    def stop(self, name: str) -> bool:
        """Stop a container, as ``Container.stop``."""
        ended_well = self._all[name].stop()
        with self._lock:
            self._tell_names()
        return ended_well

    def _tell_names(self) -> None:
        """Each container answers to its service's name, as long as it runs."""
        lines = [f"{each.address} {each.service.name} {each.name}" for each in self._all.values() if each.runs]
        self._names.write_text("\n".join(lines) + "\n")
        self._dns.send_signal(signal.SIGHUP)

    def _watch(self) -> None:
        """Start containers again that ended by themselves; ``restart: unless-stopped``."""
        while True:
            time.sleep(RESTART_S)
            with self._lock:
                for each in self._all.values():
                    if each.wanted and not each.runs:
                        _log.info("%s has ended, and is started again", each.name)
                        try:
                            each.clear()
                            each.start()
                        except TandemError as error:  # the next time
                            _log.warning("%s", error)
                        self._tell_names()


def run(command: Sequence[str], *, timeout_s: float = 600.0, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a command and return what it said."""
    result = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    if check and result.returncode != 0:
        said = (result.stderr or result.stdout).strip()[-2000:]
        raise TandemError(f"{Path(command[0]).name} ended with {result.returncode}: {said}")
    return result


def remove_memory_groups() -> None:
    """Remove what containers left in the machine's control groups, once the last process has gone."""
    end_s = time.monotonic() + GONE_S
    for group in MEMORY.glob("tandem-deployed-*"):
        while group.exists() and time.monotonic() < end_s:
            with suppress(OSError):
                group.rmdir()
            time.sleep(0.1)


def read_image(store: Sequence[str], name: str) -> Image:
    """An image of buildah, mounted; it stays mounted as long as this mount namespace."""
    config = json.loads(run([*store, "inspect", "--type", "image", name]).stdout)["OCIv1"]["config"]
    container = run([*store, "from", "--pull-never", name]).stdout.strip()
    root = Path(run([*store, "mount", container]).stdout.strip())
    return Image(
        root=root,
        user=config.get("User") or "0:0",
        entrypoint=config.get("Entrypoint") or (),
        command=config.get("Cmd") or (),
        environment=dict(each.split("=", 1) for each in config.get("Env", [])),
        directory=config.get("WorkingDir") or "/",
    )


def _account(user: str, root: Path) -> tuple[str, str, str]:
    """The numbers of a user of an image and of his group, and his home."""
    name, _, group = user.partition(":")
    for line in (root / "etc" / "passwd").read_text().splitlines():
        words = line.split(":")
        if name in (words[0], words[2]):
            return words[2], group or words[3], words[5]
    if name.isdigit():
        return name, group or "0", "/"
    raise TandemError(f"the image has no user {name}")


def need_programs(names: Sequence[str]) -> None:
    """Stop where a program is missing."""
    if missing := [name for name in names if shutil.which(name) is None]:
        where = "apt-get install buildah debootstrap dnsmasq-base iproute2 socat tini"
        raise TandemError(f"needs {', '.join(missing)}; on Debian: {where}")
