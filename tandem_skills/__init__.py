"""The names of Tandem that programs use. Importing it takes no longer than importing Gymnasium, whose ids it registers.

import tandem_skills as tandem

bob = tandem.load("panda-cube@champion")
world = gymnasium.make("tandem_skills:tandem/Tabletop-v1", config=bob.config.world)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import service

if not hasattr(service, "make_env"):
    raise ImportError(
        f"tandem_skills needs its package 'service', and Python finds another: {service.__file__ or service.__path__}; "
        "rename that file, or run where it does not come first"
    )

from service.envs.gym import registration as _registration  # noqa: F401 - gymnasium.make finds what it registers

if TYPE_CHECKING:
    from service import __version__ as __version__
    from service import evaluate as evaluate
    from service import load as load
    from service import make_env as make_env
    from service import train as train
    from service.actors.evaluation import Evaluation as Evaluation
    from service.base import errors as errors
    from service.config import Config as Config
    from service.envs.gym.tabletop import EnvState as EnvState
    from service.envs.gym.tabletop import TabletopEnv as TabletopEnv
    from service.envs.gym.vector import TabletopVectorEnv as TabletopVectorEnv
    from service.envs.task import Bodies as Bodies
    from service.envs.task import Task as Task
    from service.envs.task import View as View
    from service.envs.tasks import find_task as find_task
    from service.generator.sources import GoalSource as GoalSource
    from service.generator.sources import Known as Known
    from service.methods.compose import ComposePrimitives as ComposePrimitives
    from service.methods.compose import ComposePrimitivesVector as ComposePrimitivesVector
    from service.methods.intrinsic_reward import IntrinsicReward as IntrinsicReward
    from service.methods.method import Iteration as Iteration
    from service.methods.method import Method as Method
    from service.registry.loading import Trained as Trained

_PLACES = {
    "load": "service",
    "train": "service",
    "evaluate": "service",
    "make_env": "service",
    "errors": "service.base.errors",
    "Task": "service.envs.task",
    "View": "service.envs.task",
    "Bodies": "service.envs.task",
    "find_task": "service.envs.tasks",
    "TabletopEnv": "service.envs.gym.tabletop",
    "EnvState": "service.envs.gym.tabletop",
    "TabletopVectorEnv": "service.envs.gym.vector",
    "ComposePrimitives": "service.methods.compose",
    "ComposePrimitivesVector": "service.methods.compose",
    "Config": "service.config",
    "Method": "service.methods.method",
    "Iteration": "service.methods.method",
    "Trained": "service.registry.loading",
    "Evaluation": "service.actors.evaluation",
    "GoalSource": "service.generator.sources",
    "Known": "service.generator.sources",
    "IntrinsicReward": "service.methods.intrinsic_reward",
    "__version__": "service",
}
"""Modules of the names, which are imported when they are asked for."""
__all__ = [name for name in _PLACES if not name.startswith("_")]


if not TYPE_CHECKING:  # for which a name that is not above would be anything

    def __getattr__(name: str) -> Any:
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no {name!r}; it has {', '.join(_PLACES)}")
        module = importlib.import_module(_PLACES[name])
        return module if module.__name__.rpartition(".")[2] == name else getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
