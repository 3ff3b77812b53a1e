"""Builds the images of a compose file with buildah: Tandem's from its Dockerfile, and stand-ins for others from Debian.

Debian's archive gives the base (debootstrap) and the programs in place of images of Docker Hub; the base has the
certificates of this machine.
"""

from __future__ import annotations

import functools
import http.server
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT
from service.base.errors import TandemError
from tools.containers import PATH, Image, read_image, run

DEBIAN = "http://deb.debian.org/debian"
BASE, TANDEM, OTHERS = "localhost/python:debian", "localhost/tandem:cpu", "localhost/programs:debian"
PACKAGES = "python3,python3-venv,python-is-python3,ca-certificates"
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
PROGRAMS = f"""FROM {BASE}
RUN apt-get update \\
 && apt-get install -y --no-install-recommends redis-server nginx-light prometheus wget \\
 && useradd --system --no-create-home nginx \\
 && ln -sf /dev/stderr /var/log/nginx/error.log \\
 && install -d -o redis -g redis /data \\
 && install -d -o nobody -g nogroup /prometheus
"""
STAND_INS: Mapping[str, Mapping[str, Any]] = {
    "redis": {"directory": "/data"},
    "nginx": {},
    "prom/prometheus": {"user": "nobody", "entrypoint": ["/bin/prometheus"], "directory": "/prometheus"},
}
"""What the images of these names say of themselves, as far as the compose file leaves it to them."""
BUILD_S = 3600.0
INDEX_PORT = 8977
"""Of the index for the build; always the same, or nothing built before would be used again."""


class Store:
    """Images of buildah in a directory.

    Args:
        directory: for all layers; a few gigabytes.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        place = ["--root", str(directory / "store"), "--runroot", str(directory / "run")]
        self._buildah = ["buildah", *place, "--storage-driver", "overlay"]

    def build(self, wheels: Path | None) -> None:
        """Build what is missing or has changed.

        Args:
            wheels: directory with a wheel of torch, in place of the index that the Dockerfile names.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        if run([*self._buildah, "inspect", "--type", "image", BASE], check=False).returncode != 0:
            self._import_base()
        file = ROOT / "deploy" / "docker" / "Dockerfile"
        with _index_of(wheels) as url:
            given = [f"--build-arg=PYTHON={BASE}", *([f"--build-arg=TORCH_INDEX={url}"] if url else [])]
            self._build(TANDEM, ["--file", str(file), *given, str(ROOT)])
        others = self.directory / "programs"
        others.mkdir(exist_ok=True)
        (others / "Dockerfile").write_text(PROGRAMS)
        self._build(OTHERS, [str(others)])

    def images(self) -> dict[str, Image]:
        """The images by the names that the compose file has for them, without their tags.

        They are mounted, so this is to be called in the mount namespace that uses them.
        """
        self.forget()
        others = read_image(self._buildah, OTHERS)
        found = {name: replace(others, **said) for name, said in STAND_INS.items()}
        return found | {"tandem": read_image(self._buildah, TANDEM)}

    def forget(self) -> None:
        """Remove the working containers of an earlier run; images stay."""
        run([*self._buildah, "rm", "--all"], check=False)

    def describe(self) -> dict[str, Any]:
        """Id and size of Tandem's image."""
        row = run([*self._buildah, "images", "--format", "{{.ID}} {{.Size}}", TANDEM]).stdout.split(maxsplit=1)
        return {"id": row[0], "size": row[1].strip()}

    def _build(self, name: str, words: Sequence[str]) -> None:
        run([*self._buildah, "build", "--isolation", "chroot", "--layers", "--tag", name, *words], timeout_s=BUILD_S)

    def _import_base(self) -> None:
        files, archive = self.directory / "base", self.directory / "base.tar"
        shutil.rmtree(files, ignore_errors=True)
        options = ["--variant=minbase", f"--include={PACKAGES}"]
        run(["debootstrap", *options, "bookworm", str(files), DEBIAN], timeout_s=BUILD_S)
        shutil.copy(CERTIFICATES, files / CERTIFICATES.relative_to("/"))
        run(["tar", "-C", str(files), "-cf", str(archive), "."])
        container = run([*self._buildah, "from", "scratch"]).stdout.strip()
        run([*self._buildah, "add", container, str(archive), "/"])
        run([*self._buildah, "config", "--env", f"PATH={PATH}", container])
        run([*self._buildah, "commit", container, BASE])
        run([*self._buildah, "rm", container])
        shutil.rmtree(files)
        archive.unlink()


@contextmanager
def _index_of(wheels: Path | None) -> Iterator[str | None]:
    """The address of a package index that has torch, as behind a mirror; None for the Dockerfile's own."""
    if wheels is None:
        yield None
        return
    if not list(wheels.glob("torch-*.whl")):
        raise TandemError(f"--wheels {wheels}: no wheel of torch there")
    handler = functools.partial(_Index, directory=str(wheels))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", INDEX_PORT), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{INDEX_PORT}/"
    finally:
        server.shutdown()
        server.server_close()


class _Index(http.server.SimpleHTTPRequestHandler):
    """A directory of wheels as the page of one package."""

    def translate_path(self, path: str) -> str:
        return super().translate_path(path.removeprefix("/torch"))

    def log_message(self, format: str, *args: Any) -> None:
        pass
