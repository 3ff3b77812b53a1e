"""The status service as a Ray actor: it costs the driver nothing, and Ray restarts it when it dies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from service.base.ports import choose_port
from service.cluster.ray_connection import StatusOptions
from service.store.address import RedisAddress

START_S = 60.0


class StatusWorker:
    """Serves run directories, Redis and the registry, which it only reads but for stop requests and aliases.

    Args:
        options: where it listens.
        runs_dir: directory of run directories.
        registry: root of the registry.
        redis: None where none is configured; run directories then tell everything.
    """

    def __init__(self, options: StatusOptions, runs_dir: Path, registry: Path, redis: RedisAddress | None) -> None:
        self._options, self._runs_dir, self._registry, self._redis = options, runs_dir, registry, redis
        if ray.get_runtime_context().was_current_actor_reconstructed:  # it is not asked a second time
            self.start()

    def start(self) -> str:
        """Serve from now on.

        Returns:
            Where the driver's machine reaches the service.

        Raises:
            StatusError: the address cannot be had, or a public one without a token.
        """
        from service.registry.registry import Registry
        from service.status.run_reader import open_reader
        from service.status.server import StatusServer

        reader, options = open_reader(self._runs_dir, self._redis), self._options
        registry = Registry(self._registry)
        assert options.port is not None, "chosen"
        self._server = StatusServer(reader, registry, token=options.token, host=options.host, port=options.port)
        self._server.start()
        return self._server.url


@contextmanager
def serving(options: StatusOptions, runs_dir: Path, registry: Path, redis: RedisAddress | None) -> Iterator[str]:
    """Serve for as long as the block runs, on the driver's machine, where the run directories are.

    Yields:
        The service's URL.

    Raises:
        StatusError: the address cannot be had, or a public one without a token.
        RayError: it does not start.
    """
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    actor = ray.remote(StatusWorker).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here)
    # chosen once: a service that is restarted must be where it was
    placed = replace(options, port=choose_port(options.host, options.port))
    handle: Any = actor.remote(placed, runs_dir.absolute(), registry.absolute(), redis)
    try:
        url: str = ray.get(handle.start.remote(), timeout=START_S)
        yield url
    finally:
        ray.kill(handle, no_restart=True)
