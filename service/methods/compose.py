"""Frozen primitives as an action space: a learner's action is the K weights with which they are composed.

``ComposePrimitives`` wraps an environment, ``ComposePrimitivesVector`` many at once. What a learner sees stays as it
was; what it sets, K numbers in [-1, 1], are weights on a logarithmic scale, and the environment is handed the mean of
the composition, which is deterministic and inside the range of the primitives' means (``forward.compose``). Only
ratios of weights bear on that mean. With a residual the learner sets four more numbers, a small action of its own that
is added: what primitives never learned, such as pushing where they only carry, is then in reach. NumPy alone: acting
needs no torch.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from service.base.errors import TandemError
from service.base.types import FloatArray
from service.config import WorldConfig
from service.envs.observations import layouts
from service.policies.learned_policy import compose_actions
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.loading import Trained

Info = dict[str, Any]
Positions = Callable[[Any], FloatArray]

_SEEN_BY_SKILLS = ("action", "positions", "layout")


def check_primitives(primitives: NumpyMCPPolicy | Trained) -> NumpyMCPPolicy:
    """Return what can be composed, once its manifest says that it is for this robot and layout.

    Raises:
        TandemError: a monolithic Bob, primitives of another robot or layout, or neither.
    """
    if isinstance(primitives, NumpyMCPPolicy):
        return primitives
    if not isinstance(primitives, Trained):
        raise TandemError(
            f"primitives = {primitives!r}, a {type(primitives).__name__}: give what tandem_skills.load returns"
        )
    check_robot(primitives)
    return primitives.primitives


def check_robot(trained: Trained) -> None:
    """Assert that a policy, composable or not, or skills are for this robot and layout, as far as its manifest says.

    Raises:
        TandemError: it is for another.
    """
    if trained.manifest is None:
        return
    spaces = trained.manifest.spaces
    known = layouts(trained.config.world).spaces
    wanted_spaces = {key: known[key] for key in _SEEN_BY_SKILLS} if trained.kind == "skills" else known
    wrong = {key: spaces.get(key) for key, value in wanted_spaces.items() if spaces.get(key) != value}
    if wrong:
        found, wanted = (", ".join(f"{key} {tree[key]}" for key in wrong) for tree in (wrong, known))
        raise TandemError(f"{trained.label} is for another robot or layout: {found}; this one has {wanted}")


class _ComposingWrapper:
    """The part that both wrappers share: turns weights and the last positions into actions."""

    env: Any
    _last_positions: FloatArray | None = None

    def _compose_with(
        self,
        primitives: NumpyMCPPolicy | Trained,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        positions: Positions | None,
        residual: float,
    ) -> gymnasium.Space[FloatArray]:
        """Check that these primitives fit an environment with these spaces; the space of its new actions."""
        if not 0.0 <= residual <= 1.0:
            raise TandemError(f"residual = {residual}: a share of the robot's greatest action, from 0 to 1")
        self.primitives, self._residual = check_primitives(primitives), residual
        if not isinstance(action_space, gymnasium.spaces.Box) or action_space.shape != (self.primitives.action_size,):
            raise TandemError(
                f"the environment's actions are {action_space}; the primitives act by {self.primitives.action_size} "
                "numbers: end-effector displacement 3, change of the finger width"
            )
        shown: Any = observation_space
        if named := isinstance(observation_space, gymnasium.spaces.Dict):
            shown = observation_space.get("observation")
        if positions is None and (
            not isinstance(shown, gymnasium.spaces.Box) or shown.shape != (self.primitives.num_positions,)
        ):
            raise TandemError(
                f"the environment's observations are {shown}; the primitives see the "
                f"{self.primitives.num_positions} positions of service.envs.observations: give positions=, which takes "
                "them out of an observation"
            )
        world = getattr(self.env.unwrapped, "config", None)
        if positions is None and isinstance(primitives, Trained) and isinstance(world, WorldConfig):
            there, known = (layouts(each).positions.columns for each in (world, primitives.config.world))
            if there != known:
                raise TandemError(
                    f"{primitives.label} sees {', '.join(known)}, and the environment shows {', '.join(there)}: name "
                    "primitives of such a world"
                )
        self._take = positions or (operator.itemgetter("observation") if named else lambda observation: observation)
        self._low, self._high = action_space.low, action_space.high
        self._num_actions = self.primitives.num_primitives + (self.primitives.action_size if residual else 0)
        return gymnasium.spaces.Box(-1.0, 1.0, (self._num_actions,), np.float32)

    def reset(self, *, seed: Any = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._observe(observation), info

    def step(self, action: FloatArray) -> Any:
        """Act by the composition with these weights.

        Args:
            action: (K,), or (N, K) for N environments; with a residual K + 4 instead of K.

        Raises:
            TandemError: another shape.
        """
        observation, *rest = self.env.step(self._compose(action))
        return (self._observe(observation), *rest)

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The environment's own, where it has goals: hindsight relabelling asks for it here."""
        return self._inner("compute_reward")(achieved_goal, desired_goal, info)

    def state(self) -> Any:
        """The environment's own, where it can be saved; composing has none."""
        return self._inner("state")()

    def restore(self, state: Any) -> Any:
        """Go back to a saved state, and return the observation there: the next composition acts on it.

        Nothing in between may change observations.
        """
        return self._observe(self._inner("restore")(state))

    def _inner(self, name: str) -> Any:
        """A method of the environment, or of one that it wraps; a ``VectorEnv`` is not asked for what it wraps."""
        find = getattr(self.env, "get_wrapper_attr", None)
        return find(name) if find is not None else getattr(self.env, name)

    def _observe(self, observation: Any) -> Any:
        """Keep the positions that the next composition acts on; gives the observation back."""
        self._last_positions = np.array(self._take(observation), dtype=np.float32)
        return observation

    def _compose(self, actions: FloatArray) -> FloatArray:
        """(..., 4) actions inside the environment's range."""
        if self._last_positions is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        expected = (*self._last_positions.shape[:-1], self._num_actions)
        if np.shape(actions) != expected:
            raise TandemError(
                f"action: expected shape {expected}, a number for each of {self.primitives.num_primitives} primitives"
                f"{' and 4 of the residual' if self._residual else ''}, got {np.shape(actions)}; an orchestrator acts "
                "with the primitives it was trained with"
            )
        made = compose_actions(self.primitives, self._last_positions, np.asarray(actions), self._residual)
        return np.clip(made, self._low, self._high)


class ComposePrimitives(
    _ComposingWrapper, gymnasium.Wrapper[Any, FloatArray, Any, FloatArray], gymnasium.utils.RecordConstructorArgs
):
    """An environment whose action is K weights in [-1, 1]; everything else stays.

    Args:
        env: acts by the four numbers of ``TabletopEnv``, and shows the P positions that primitives see.
        primitives: what ``tandem_skills.load`` returns, or its ``.primitives``. Never changed.
        positions: takes the (P,) positions (``service.envs.observations``) out of an observation. By default they are
            the observation itself, or its entry ``observation``.
        residual: above 0, the action has four more numbers, which are added to the composition, times this.

    Raises:
        TandemError: primitives of another robot or layout, an environment that does not fit them, or a residual that is
            not from 0 to 1.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, FloatArray],
        primitives: NumpyMCPPolicy | Trained,
        *,
        positions: Positions | None = None,
        residual: float = 0.0,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, primitives=primitives, positions=positions, residual=residual
        )
        super().__init__(env)
        self.action_space = self._compose_with(primitives, env.observation_space, env.action_space, positions, residual)


class ComposePrimitivesVector(_ComposingWrapper, gymnasium.vector.VectorWrapper[Any, FloatArray, Any, FloatArray, Any]):
    """N environments at once, as in ``ComposePrimitives``: actions are (N, K), ``positions`` takes out (N, P)."""

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv[Any, FloatArray, Any],
        primitives: NumpyMCPPolicy | Trained,
        *,
        positions: Positions | None = None,
        residual: float = 0.0,
    ) -> None:
        super().__init__(env)
        self.single_action_space = self._compose_with(
            primitives, env.single_observation_space, env.single_action_space, positions, residual
        )
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, env.num_envs)
