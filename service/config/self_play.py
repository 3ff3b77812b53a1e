"""Configuration of self-play: the game, the task generator, the networks and the learner.

Defaults follow the paper; where the paper is silent, the source is in the field's description.
"""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, PositiveInt, model_validator

from service.base.user_code import parse_reference
from service.config.frozen import FrozenModel
from service.config.run import CELL_SIZE_M, Config


class GameConfig(FrozenModel):
    """Asymmetric self-play: who plays how long, for which rewards."""

    num_worlds: int = Field(160, ge=1, description="worlds stepped together by one actor")
    num_goals: int = Field(5, ge=1, description="most rounds from one reset (OpenAI 2021: 5)")
    alice_plays: bool = Field(
        True,
        description="without her, a control, Bob plays goals of the task generator only, and each round starts where "
        "his last one ended. Needs another generator.goal_source than alice",
    )
    alice_steps: int = Field(40, ge=1, description="most steps of her turn")
    alice_steps_min: int | None = Field(
        None,
        ge=1,
        description="a round's length is drawn from here to ``alice_steps``; None: always ``alice_steps``. Short turns "
        "make her lift early, long ones reach objects far from the gripper",
    )
    bob_steps: int = Field(
        40,
        ge=1,
        description="most steps of his turn, for each object that is not at its goal at the start; where all are, for "
        "each of them",
    )
    success_distance_m: float = Field(0.05, gt=0.0, description="paper: 5 cm; also the least move of a valid goal")
    alice_valid_reward: float = Field(1.0, description="paper, appendix")
    alice_difficult_reward: float = Field(5.0, description="paper, appendix: added when Bob fails")
    alice_novelty_reward: float = Field(
        0.0,
        ge=0.0,
        description="added for a valid goal in a cell without earlier ones; less the more there lately were, by "
        "1 / sqrt(1 + n), and the more cells there are with goals, down to nothing; 0 in the paper",
    )
    blocked_gripper_fraction: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="share of games in which the gripper stays closed for both players, whatever they ask for; 0 in "
        "the paper. What is learned there are primitives that push",
    )
    blocked_gripper_min_success: float = Field(
        0.0,
        ge=0.0,
        le=1.0,
        description="new games may have a blocked gripper while Bob's mean success rate over all goal cells, 0 where "
        "no goal was proposed or tried, is at least this; below, they keep him from learning to lift",
    )
    bob_all_reward: float = Field(
        0.0, ge=0.0, description="of having all objects at their goals, besides that of each; OpenAI 2021: 5"
    )
    bob_success_reward: float = Field(
        1.0, gt=0.0, description="when the object comes onto the goal; taken back when it leaves (OpenAI 2021)"
    )
    bob_margin_m: float = Field(
        0.0,
        ge=0.0,
        description="Bob's goals count as reached this much inside ``success_distance_m``; 0 in the paper. What he "
        "leaves just inside drifts out again after his turn, or in another world",
    )
    bob_margin_after_updates: int = Field(
        0,
        ge=0,
        description="updates of the learner before that margin counts; asked too early, it slows him (log T15)",
    )
    bob_hold_steps: int = Field(
        1,
        ge=1,
        description="Bob's turn ends once the object was on the goal for so many steps in a row; 1: the moment it is "
        "solved (paper). More teach him to stay: the goals of evaluation and downstream count at the last step",
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.alice_steps_min is not None and self.alice_steps_min > self.alice_steps:
            raise ValueError(f"alice_steps_min {self.alice_steps_min} must not exceed alice_steps {self.alice_steps}")
        if self.bob_margin_m >= self.success_distance_m:
            raise ValueError(
                f"bob_margin_m {self.bob_margin_m} must be less than success_distance_m {self.success_distance_m}"
            )
        return self


GOAL_SOURCES = ("alice", "reached", "uniform")


class GeneratorConfig(FrozenModel):
    """The task generator: which goals and opponents a round uses, and when the run is over."""

    past_opponent_fraction: float = Field(
        0.2, ge=0.0, le=0.5, description="share of worlds, each way (OpenAI 2021: 20 %); none without Alice"
    )
    opponent_pool_size: int = Field(5, ge=1, description="past players that are kept")
    opponent_interval: int = Field(10, ge=1, description="iterations between two snapshots of the players")
    goal_source: str = Field(
        "alice",
        description="of the goals that Bob plays besides those that Alice has just proposed. alice: her earlier ones. "
        "reached: new ones in cells to which either player has brought the object in a game, and in cells beside "
        "these, weighted by p (1 - p) of tasks like them (SFL, Rutherford et al. 2024). uniform, to compare with: "
        "drawn as those of an evaluation. All but alice's begin where worlds are now, and every second with the "
        "object in the hand once there are such starts. Or FILE.py:CLASS, a GoalSource of yours",
    )
    replay_fraction: float = Field(
        0.0,
        ge=0.0,
        le=1.0,
        description="share of valid goals replaced by replayed ones once Alice has proposed in every goal cell; before "
        "that, as much less as cells are missing",
    )
    replay_invalid: bool = Field(False, description="give Bob a replayed goal where Alice's goal was invalid")
    replay_from_reset: bool = Field(
        False, description="replayed goals also start where games do, when Bob can learn from that"
    )
    replay_buffer_size: int = Field(4096, ge=1, description="goals of Alice that are kept")
    cell_size_m: float = Field(CELL_SIZE_M, gt=0.0, description="edge of a goal cell of the difficulty grid")
    novelty_window: int = Field(50, ge=1, description="iterations without a new cell before the run may stop")
    stop_success_rate: float = Field(
        0.95, gt=0.0, le=1.0, description="of all that Bob plays in that window, the share that he has to solve"
    )


class MLPConfig(FrozenModel):
    """A multi-layer perceptron with ELU."""

    hidden_sizes: tuple[PositiveInt, ...] = Field((256, 256), min_length=1, description="units of each layer")


class MCPConfig(FrozenModel):
    """Bob's Multiplicative Compositional Policy."""

    num_primitives: int = Field(4, ge=1, description="K; paper: 4")
    trunk_hidden_sizes: tuple[PositiveInt, ...] = Field((256,), min_length=1, description="shared by the primitives")
    primitive_hidden_size: int = Field(128, ge=1, description="one hidden layer of each primitive's own")
    gate_hidden_sizes: tuple[PositiveInt, ...] = Field((256, 256), min_length=1, description="units of each layer")
    weight_floor: float = Field(0.01, gt=0.0, lt=1.0, description="least gate weight, bounds the composite variance")
    log_std_min: float = Field(-2.0, description="of a primitive")
    log_std_max: float = Field(0.5, description="of a primitive")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.log_std_min >= self.log_std_max:
            raise ValueError(f"log_std_min {self.log_std_min} must be below log_std_max {self.log_std_max}")
        return self


class PolicyConfig(FrozenModel):
    """Networks of both players."""

    alice: MLPConfig = MLPConfig()
    alice_log_std_min: float = Field(-2.5, description="least log of the std of her actions")
    alice_log_std_max: float = Field(0.5, description="greatest log of the std of her actions")
    bob: MCPConfig = MCPConfig()
    monolithic_bob: MLPConfig | None = Field(
        None, description="a Bob of one Gaussian network instead of primitives: an ablation, nothing to publish"
    )
    value: MLPConfig = MLPConfig()

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.alice_log_std_min >= self.alice_log_std_max:
            raise ValueError(
                f"alice_log_std_min {self.alice_log_std_min} must be below alice_log_std_max {self.alice_log_std_max}"
            )
        return self


class PPOConfig(FrozenModel):
    """One player's PPO (Schulman et al. 2017)."""

    learning_rate: float = Field(3e-4, gt=0.0, description="of Adam, at the start; it follows target_kl")
    gamma: float = Field(0.99, gt=0.0, le=1.0, description="discount of a step")
    gae_lambda: float = Field(0.95, ge=0.0, le=1.0, description="lambda of generalised advantage estimation")
    clip: float = Field(0.2, gt=0.0, lt=1.0, description="epsilon: the ratio of the surrogate is clipped to 1 +- this")
    decoupled: bool = Field(
        True, description="clip around the policy at the start of the update rather than the one that acted"
    )
    dual_clip: float = Field(3.0, gt=1.0, description="bound of the surrogate for negative advantages (Ye et al. 2020)")
    entropy_weight: float = Field(0.001, ge=0.0, description="of the entropy bonus in the loss")
    num_epochs: int = Field(3, ge=1, description="passes over the samples in an update")
    minibatch_size: int = Field(3200, ge=2, description="samples of a gradient step")
    max_grad_norm: float = Field(0.5, gt=0.0, description="longer gradients are shortened to this")
    target_kl: float = Field(0.02, gt=0.0, description="an update stops early once its mean KL passes 1.5 x this")
    value_first_updates: int = Field(
        0,
        ge=0,
        description="first updates of a run in which the value network learns and the policy stays: one that begins "
        "from a trained policy (--from) would else be led by a network that knows nothing",
    )
    rate_decay_after_updates: int | None = Field(
        None,
        ge=1,
        description="from this update N on the bound of the learning rate falls as N over the number of updates: steps "
        "small enough for the average of a policy to settle. None: it stays",
    )


class BobPPOConfig(PPOConfig):
    """Bob's PPO."""

    mirror: Literal["none", "random"] = Field(
        "none",
        description="symmetry augmentation, since the task is the same from left and right. random: learn from each "
        "sample or, as likely, from its reflection in y, and from both of each demonstration; in worlds that are not "
        "alike on both sides there is no reflection",
    )


class CloningConfig(FrozenModel):
    """PPO-clipped cloning of demonstrations, beside a player's own turns."""

    weight: float = Field(0.5, ge=0.0, description="beta")
    clip: float = Field(0.2, gt=0.0, lt=1.0, description="epsilon")
    rows_per_sample: float = Field(
        0.5, gt=0.0, le=4.0, description="demonstrated steps in a minibatch for each of the player's own"
    )
    num_iterations: int = Field(1, ge=1, description="demonstrations of that many iterations are kept; 1 is on-policy")
    mean_only: bool = Field(
        False,
        description="clone by the mean and leave the std alone, or it also copies a demonstrator's noise. What Bob's "
        "primitives weigh depends on their stds, so his may still change",
    )


class SelfImitationConfig(CloningConfig):
    """Self-imitation (Oh et al. 2018): Alice clones those of her own turns that were paid well.

    Chance lifts the object once in hundreds of turns. Policy gradients of one update hardly see it; cloned for some
    iterations, it becomes a habit.
    """

    weight: float = Field(0.0, ge=0.0, description="0: off")
    num_iterations: int = Field(8, ge=1, description="turns of that many iterations are kept")
    min_reward: float = Field(
        9.0,
        description="least reward of a turn that is cloned. A valid goal that Bob fails pays 6 with the usual rewards, "
        "so 9 asks for a novelty reward of 3 on top: few goals of late where this one lies",
    )


class ABCConfig(CloningConfig):
    """Alice behavioural cloning (OpenAI 2021): PPO-clipped cloning of Alice's turns whose goal Bob failed."""

    hindsight: bool = Field(
        False,
        description="also clone steps of Bob's failed turns, relabelled with where the object ended (Ghosh et al. "
        "2021); no more than there are of Alice's",
    )


class LearnerConfig(FrozenModel):
    """Central learner."""

    device: Literal["cpu", "cuda", "auto"] = Field(
        "cpu", description="of the learner; auto: cuda where there is one, else cpu. These networks gain little from it"
    )
    num_threads: int = Field(
        1, ge=1, description="torch threads; one leaves the other core to the worlds, and two spin when a core is taken"
    )
    alice: PPOConfig = PPOConfig()
    bob: BobPPOConfig = BobPPOConfig()
    bob_ema_decay: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="the Bob that is evaluated and published is an exponential moving average of his parameters, over "
        "about the last 1 / (1 - decay) versions, or an eighth of all if that is less; 0: the last version. Acting "
        "and learning do not use it",
    )
    bob_help_max_success: float = Field(
        1.0,
        ge=0.0,
        le=1.0,
        description="Bob clones demonstrations and learns from mirrored samples only in updates in which he solved no "
        "more than this share of his turns. Both speed up what he learns first. Later most of what he fails is "
        "standing and dithering, and clones teach him that; and a mirrored action is far from what he would do",
    )
    abc: ABCConfig = ABCConfig()
    self_imitation: SelfImitationConfig = SelfImitationConfig()


class SelfPlayConfig(Config):
    """Self-play: Alice proposes goals, Bob learns to reach them."""

    method: Literal["self-play"] = "self-play"
    game: GameConfig = GameConfig()
    generator: GeneratorConfig = GeneratorConfig()
    policy: PolicyConfig = PolicyConfig()
    learner: LearnerConfig = LearnerConfig()

    made_in: ClassVar[str] = "service.methods.self_play"
    runs_on_ray: ClassVar[bool] = True
    makes: ClassVar[Literal["primitives"]] = "primitives"
    part: ClassVar[str] = "bob"
    resumable: ClassVar[tuple[str, ...]] = ("run.", "learner.alice.learning_rate=", "learner.bob.learning_rate=")

    @property
    def success_distance_m(self) -> float:
        """Greatest distance from object to goal that counts as success."""
        return self.game.success_distance_m

    @property
    def publishable(self) -> bool:
        """Whether Bob has primitives."""
        return self.policy.monolithic_bob is None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        generator = self.generator
        if generator.goal_source not in GOAL_SOURCES and parse_reference(generator.goal_source) is None:
            raise ValueError(
                f"generator.goal_source = {generator.goal_source!r}: choose one of {', '.join(GOAL_SOURCES)}, or "
                "FILE.py:CLASS"
            )
        if not self.game.alice_plays and (
            generator.goal_source in ("alice", "reached") or not generator.replay_invalid
        ):
            raise ValueError(
                "without Alice there are no goals: set generator.goal_source=uniform and "
                "generator.replay_invalid=true, or game.alice_plays=true"
            )
        if generator.goal_source != "alice" and not (generator.replay_fraction or generator.replay_invalid):
            raise ValueError(
                f"generator.goal_source = {generator.goal_source!r}, but none of its goals would be played: set "
                "generator.replay_fraction above 0, or generator.replay_invalid=true"
            )
        game, how = self.game, self.learner.self_imitation
        most = game.alice_valid_reward + game.alice_difficult_reward + game.alice_novelty_reward
        if how.weight and how.min_reward > most:
            raise ValueError(
                f"learner.self_imitation.min_reward = {how.min_reward:g}, but no turn of Alice's pays more than "
                f"{most:g}, the sum of game.alice_valid_reward, alice_difficult_reward and alice_novelty_reward: raise "
                "one of them, lower it, or set learner.self_imitation.weight=0"
            )
        return self
