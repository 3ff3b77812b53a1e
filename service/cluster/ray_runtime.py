"""The Ray cluster as the place of a run's workers, with what surrounds a run there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from service.base.errors import ConfigError
from service.cluster.ray_connection import ClusterOptions, explaining_ray_errors
from service.config import Config
from service.config.self_play import SelfPlayConfig
from service.methods.method import Method
from service.registry.loading import Trained
from service.runs.train import Runtime
from service.store.address import address_from_environment
from service.store.disk_reader import run_id_of

if TYPE_CHECKING:
    from service.cluster.watch import RayletWatch

_logger = logging.getLogger(__name__)


class RayRuntime(Runtime):
    """Workers on the cluster that this process is connected to, by the time they are made.

    Args:
        options: of the cluster.
    """

    name = "ray"

    def __init__(self, options: ClusterOptions) -> None:
        self._options = options
        self._raylet: RayletWatch | None = None

    def check(self, config: Config) -> None:
        """Check that the method has workers for a cluster; devices are another machine's.

        Raises:
            ConfigError: it has not.
        """
        if not config.runs_on_ray:
            raise ConfigError(f"method = {config.method}: it runs in one process; use --runtime local")

    def make(self, config: Config, registry: Path | str, start_from: Trained | None) -> Method:
        """Make self-play, whose workers start with it."""
        from service.cluster.self_play import RaySelfPlay

        assert isinstance(config, SelfPlayConfig), "checked"
        return RaySelfPlay(config, self._options, start_from, self._raylet)

    @contextmanager
    def around(self, directory: Path, registry: Path, end_now: Callable[[str], None]) -> Iterator[None]:
        """Watch over the raylet of this machine, and serve the run's status."""
        from service.cluster.status_actor import serving
        from service.cluster.watch import RayletWatch

        with ExitStack() as stack:
            stack.enter_context(explaining_ray_errors())
            self._raylet = stack.enter_context(RayletWatch(end_now))
            if self._options.status is not None:
                runs = directory.absolute().parent
                url = stack.enter_context(serving(self._options.status, runs, registry, address_from_environment()))
                _logger.info("status: %s/v1/runs/%s", url, run_id_of(directory))
            yield
