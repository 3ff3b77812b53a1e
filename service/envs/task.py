"""A task: what it changes in the world, where its goals are, what counts as success, and what is paid.

A task is data, and up to five functions over a ``View`` of N worlds: ``starts``, ``goals``, ``success``, ``reward``
and ``remember``. ``service.envs.rules`` applies one to worlds that are played.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from service.base.types import Array, BoolArray, FloatArray, StateArray
from service.base.user_code import CodeError, find, parse_reference
from service.envs.observations import each_object

if TYPE_CHECKING:
    from service.config import WorldConfig
    from service.envs.sampling import GoalKind


EPISODE_STEPS = 50
"""Of a task that does not say (paper: 50)."""


@dataclass(frozen=True, slots=True)
class Bodies:
    """Places and velocities of the K objects of N worlds; ``bodies[:, k]`` has those of object k."""

    place: StateArray
    """(N, K, 3) centres, metres."""
    velocity: StateArray
    """(N, K, 3) m/s."""

    def __getitem__(self, key: Any) -> Bodies:
        """Select worlds, or objects."""
        known = not isinstance(self.velocity, _NotGiven)
        return Bodies(self.place[key], self.velocity[key] if known else self.velocity)


@dataclass(frozen=True, slots=True)
class View:
    """What the functions of a task see of N worlds, after a step."""

    objects: Bodies
    """Place and velocity of the K objects, (N, K, 3) each."""
    gripper: StateArray
    """(N, 3) point between the fingertips, metres."""
    fingers: StateArray
    """(N,) distance of the fingertips, metres."""
    contacts: BoolArray
    """(N, K, 2) whether the left and the right finger touched the object during the last step."""
    goal: StateArray
    """(N, K, 3) metres; of ``goals``, the places of the objects."""
    elapsed: NDArray[np.int64]
    """(N,) steps since the episode began."""
    memory: StateArray
    """(N, M) what ``remember`` gave last; 0 when an episode begins."""

    def of(self, worlds: BoolArray | slice) -> View:
        """Select worlds by a (N,) mask or a slice."""
        parts = (getattr(self, each.name) for each in fields(self))
        picked: list[Any] = [part if isinstance(part, _NotGiven) else part[worlds] for part in parts]
        return View(*picked)

    def rows(self) -> FloatArray:
        """Copy the numbers but goal and memory as (N, V) float32 for a replay buffer; ``of_rows`` reads them."""
        parts = self.objects.place, self.objects.velocity, self.gripper, self.fingers, self.contacts, self.elapsed
        rows: FloatArray = np.concatenate(
            [each.reshape(len(self.elapsed), -1) for each in parts], axis=1, dtype=np.float32
        )
        return rows

    @classmethod
    def of_rows(cls, rows: FloatArray, goal: FloatArray) -> View:
        """Make a view of (N, V) rows, with (N, K, 3) goals and without memory."""
        num, many = goal.shape[:2]
        place, velocity, gripper, fingers, contacts, elapsed = np.split(
            rows.astype(np.float64), np.cumsum([3 * many, 3 * many, 3, 1, 2 * many]), axis=1
        )
        objects = Bodies(place.reshape(goal.shape), velocity.reshape(goal.shape))
        touched = contacts.reshape(num, many, 2) > 0
        wanted, steps = goal.astype(np.float64), elapsed[:, 0].astype(np.int64)
        return cls(objects, gripper, fingers[:, 0], touched, wanted, steps, cast("Any", _NotGiven("memory")))


def num_in_rows(num_objects: int) -> int:
    """V of ``View.rows``."""
    return 8 * num_objects + 5


Function = Callable[[View], Any]
"""Of a view of N worlds to an array with a row for each."""


@dataclass(frozen=True, slots=True)
class Task:
    """A task: settings of the world, starts, goals, success and reward.

    Functions get a ``View`` of N worlds and give an array with a row for each; any NumPy will do.

    Raises:
        ValueError: a number out of range, or a memory without ``remember``, or the other way round.
    """

    title: str
    """A word or two; of ours, the name in the paper."""
    description: str = ""
    """A few words on what it asks for."""
    goals: GoalKind | Callable[[View, np.random.Generator], Any] = "mixed"
    """Where random goals are: ``table``, ``air``, ``volume``, ``mixed``, of several objects ``one``; or a function of
    the view at the start and of random numbers to (N, K, 3), metres."""
    world: Mapping[str, Any] = field(default_factory=dict)
    """Settings of a world that are replaced."""
    starts: Callable[[View, np.random.Generator], Any] | None = None
    """(N, K, 3) places of the objects' centres at the start, metres, of the view at a random one and of random numbers;
    None: random, on the table and clear of each other."""
    success: Function | None = None
    """(N,) bool; None: each object is within 5 cm of its goal. What counts is the last step of an episode."""
    reward: Function | None = None
    """(N,) float that is paid in each step; None: 1 where ``success`` is true, else 0."""
    remember: Function | None = None
    """(N, M) float, the memory from the next step on, such as the number of steps that something was so."""
    memory_size: int = 0
    """M."""
    episode_steps: int = EPISODE_STEPS
    """Steps of an episode, 40 ms each."""
    version: int = 1  # 0: other contacts (docs/decisions/0010), and Box with another rule of success (0007)
    """Version in its Gymnasium name; results of different ones are not compared."""
    name: str = ""
    """Name in commands; ``find_task`` sets it."""
    code: Mapping[str, str] = field(default_factory=dict)
    """Text of the file of a user's task; ``find_task`` sets it."""
    closed: str = ""
    """Why its functions are left out; empty where they may run."""

    def __post_init__(self) -> None:
        if not isinstance(self.world, Mapping):
            raise ValueError(f"task {self.title}: world = {self.world!r}: give a mapping of settings")
        if not isinstance(self.goals, str) and not callable(self.goals):
            raise ValueError(f"task {self.title}: goals is a {type(self.goals).__name__}: give a kind, or a function")
        for name in ("starts", "success", "reward", "remember"):
            if (given := getattr(self, name)) is not None and not callable(given):
                raise ValueError(f"task {self.title}: {name} is a {type(given).__name__}: give a function, or None")
        if type(self.episode_steps) is not int or type(self.memory_size) is not int:
            raise ValueError(
                f"task {self.title}: episode_steps = {self.episode_steps!r}, memory_size = {self.memory_size!r}: "
                "give whole numbers"
            )
        if self.episode_steps < 1 or self.memory_size < 0:
            raise ValueError(
                f"task {self.title}: episode_steps = {self.episode_steps}, memory_size = {self.memory_size}: "
                "give at least 1, and at least 0"
            )
        if (self.remember is None) != (self.memory_size == 0) and not self.closed:
            raise ValueError(
                f"task {self.title}: remember gives the memory, and memory_size says how many numbers: give both, or "
                "none of them"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a task of a user's file as its text and what was changed: others find no module with its functions."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        if not self.code:
            return Task, tuple(values.values())
        found = task_in(self.name, self.code)
        changes = {
            name: value for name, value in values.items() if name != "code" and value is not getattr(found, name)
        }
        return _found_again, (self.name, self.code, changes)

    @property
    def id(self) -> str:
        """Gymnasium name, such as ``tandem/InAir-v1``."""
        return f"tandem/{self.title}-v{self.version}"

    @property
    def is_own(self) -> bool:
        """Whether it has a success or a reward of its own."""
        return self.success is not None or self.reward is not None

    @property
    def goal_kind(self) -> GoalKind:
        """Kind of its random goals; ``mixed`` where ``goals`` is a function."""
        return self.goals if isinstance(self.goals, str) else "mixed"

    def world_from(self, world: WorldConfig) -> WorldConfig:
        """The world of this task, for primitives that were trained in ``world``."""
        from pydantic import ValidationError

        from service.config.load import explained

        tree = world.model_dump()
        for key, value in self.world.items():
            old = tree.get(key)  # a name, or a description, which another one replaces
            if isinstance(value, Mapping) and isinstance(old, dict) and "shape" not in value:
                value = {**old, **value}
            tree[key] = value
        try:
            return type(world).model_validate(tree)
        except ValidationError as error:
            raise CodeError(f"task {self.name or self.title}: world: {explained(error, type(world))}") from None

    def data(self) -> dict[str, Any]:
        """What a manifest keeps of a user's task: enough to act, without its functions."""
        from pydantic_core import to_jsonable_python

        kept = {key: getattr(self, key) for key in ("title", "description", "episode_steps", "version", "name")}
        return {**kept, "world": to_jsonable_python(dict(self.world), fallback=float), "goals": self.goal_kind}


def task_in(name: str, texts: Mapping[str, str]) -> Task:
    """Find the task that ``FILE.py`` or ``FILE.py:NAME`` names, in texts of files by their names.

    Raises:
        CodeError: the text does not run, or has no such task.
    """
    reference = parse_reference(name)
    if reference is None or reference.origin not in texts:
        raise CodeError(f"task {name!r}: it is in {', '.join(texts)}; leave its name FILE.py or FILE.py:NAME")
    task: Task = find(reference, texts, lambda each: isinstance(each, Task), "task")
    return replace(task, name=name, code={reference.origin: texts[reference.origin]})


def _found_again(name: str, texts: Mapping[str, str], changes: Mapping[str, Any]) -> Task:
    return replace(task_in(name, texts), **changes)


class _NotGiven(NDArrayOperatorsMixin):
    """Stands for a part of a view that is not known."""

    def __init__(self, part: str, hint: str = "") -> None:
        self._part, self._hint = part, hint

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise LookupError(f"{self._part} is not known where a reward is computed again, for another goal{self._hint}")

    __getitem__ = __array__ = __array_ufunc__ = __len__ = __bool__ = _refuse

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # asked for by Python, as by copy
            raise AttributeError(name)
        return self._refuse()


def view_of_places(achieved: Array, desired: Array) -> View:
    """A view of (N, 3 K) places of the objects and (N, 3 K) goals, which knows nothing else."""
    hint = "; compute_reward knows places and goals alone"
    names = ("velocity", "gripper", "fingers", "contacts", "elapsed", "memory")
    velocity, gripper, fingers, contacts, *others = (cast("Any", _NotGiven(name, hint)) for name in names)
    place, goal = each_object(achieved), each_object(desired)
    return View(Bodies(place, velocity), gripper, fingers, contacts, goal, *others)
