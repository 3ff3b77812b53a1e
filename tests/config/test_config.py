"""The configuration: defaults, YAML, overrides, what a run recorded before, and errors a user can act on."""

import math
from pathlib import Path

import pytest

from service.base.errors import ConfigError
from service.base.parsing import parse_yaml
from service.config import WorkspaceConfig, WorldConfig, dump_config, load_config
from service.config.robot import RobotConfig
from service.config.self_play import SelfPlayConfig
from service.runs.resuming import changed_settings
from tests.methods.trials import small_trial
from tests.runs.runs import assert_one_line

CONFIGS = Path(__file__).parents[2] / "configs"


def message(path=None, overrides=()) -> str:
    """The one line a user reads when this configuration is refused."""
    with pytest.raises(ConfigError) as raised:
        load_config(path, overrides)
    text = str(raised.value)
    assert "\n" not in text
    return text


def test_defaults_are_valid_and_the_papers():
    config = load_config()
    assert config == SelfPlayConfig()
    assert config.policy.bob.num_primitives == 4
    assert (config.game.alice_valid_reward, config.game.alice_difficult_reward) == (1.0, 5.0)
    assert config.game.success_distance_m == 0.05


def test_corners_of_the_workspace_by_hand():
    workspace = WorkspaceConfig(center_x_m=-0.05, center_y_m=0.1, length_x_m=0.3, length_y_m=0.2, height_m=0.4)
    assert workspace.lower_m == pytest.approx((-0.2, 0.0, 0.0))
    assert workspace.upper_m == pytest.approx((0.1, 0.2, 0.4))


def test_every_default_lies_within_its_own_range():
    # Pydantic does not validate defaults; a tree without any is validated in full.
    assert SelfPlayConfig.model_validate(SelfPlayConfig().model_dump()) == SelfPlayConfig()


def test_yaml_round_trip(tmp_path):
    config = load_config(
        overrides=["name=sphere.v2", "world.object=sphere", "policy.alice.hidden_sizes=[64, 32]", "seed=7"]
    )
    assert config != SelfPlayConfig()
    path = tmp_path / "run.yaml"
    path.write_text(dump_config(config))
    assert load_config(path) == config
    config = config.model_copy(update={"name": "1e5"})  # a text that looks like a number
    path.write_text(dump_config(config))
    assert load_config(path) == config
    path.write_text("run: {total_env_steps: 3e6}\nlearner: {bob: {learning_rate: 3e-4}}")
    assert load_config(path).run.total_env_steps == 3_000_000


@pytest.mark.parametrize("text", ["", "# nothing here\n", "null", "---\n"])
def test_an_empty_file_is_refused(tmp_path, text):
    """It is what a full disk leaves of a file."""
    path = tmp_path / "empty.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert_one_line(error.value, path, "got NoneType", "{} stands for the defaults")
    path.write_text("{}")
    assert load_config(path) == SelfPlayConfig(name="empty")  # or it would be published as one of ours


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("seed=3", "seed", 3),
        ("run.total_env_steps=200_000", "run.total_env_steps", 200_000),
        ("run.total_env_steps=2e5", "run.total_env_steps", 200_000),
        ("learner.bob.learning_rate=1e-3", "learner.bob.learning_rate", 0.001),
        ("learner.bob.learning_rate=0.001", "learner.bob.learning_rate", 0.001),
        ("learner.bob.mirror=random", "learner.bob.mirror", "random"),
        ("generator.replay_invalid=false", "generator.replay_invalid", False),
        ("world.object=sphere", "world.object", "sphere"),
        ("world.workspace.center_y_m=-0.1", "world.workspace.center_y_m", -0.1),
        ("policy.alice.hidden_sizes=[64,32]", "policy.alice.hidden_sizes", (64, 32)),
        (" seed =3", "seed", 3),
        ("name='1e5'", "name", "1e5"),
    ],
)
def test_override(override, path, value):
    node = load_config(overrides=[override])
    for part in path.split("."):
        node = getattr(node, part)
    assert node == value
    assert type(node) is type(value)


def test_overrides_beat_the_file_and_the_last_one_wins(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("seed: 1\ngame:\n  bob_steps: 50\n  alice_steps: 30\n")
    config = load_config(path, ["seed=2", "game.bob_steps=60", "seed=3"])
    assert (config.seed, config.game.bob_steps, config.game.alice_steps) == (3, 60, 30)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("seed", ["'seed'", "KEY=VALUE"]),
        ("  =3", ["'  =3'", "KEY=VALUE"]),
        ("policy.alice.hidden_sizes=[64", ["'policy.alice.hidden_sizes=[64'"]),
        ("seed.x=2", ["'seed.x=2'", "not a group"]),
        ("sed=1", ["unknown key 'sed'", "game, generator, learner, method, name, policy, run, seed, world"]),
        ("game.bob_step=1", ["unknown key 'game.bob_step'", "did you mean 'bob_steps'"]),
        ("clip=1", ["did you mean learner.abc.clip or learner.alice.clip or learner.bob.clip"]),
        ("reward_margin_m=1", ["it is a key of method=ours"]),
        ("world.workspace.width_m=1", ["unknown key 'world.workspace.width_m'", "length_x_m, length_y_m"]),
        ("world.object={shape: sphere, size_m: [0.05], w: 1}", ["'world.object.w'; known there: color, mesh, shape"]),
        ("world.obstacles=[{shape: sphere, size_m: [0.05], w: 1}]", ["'world.obstacles.0.w'; known there: color"]),
        ("world.object.mass_kg=1", ["did you mean world.object_mass_kg?"]),
        ("world.object.friction=1", ["did you mean world.friction?"]),
        ("game.num_worlds=0", ["game.num_worlds = 0"]),
        ("world.object=teapot", ["world.object = ", "teapot"]),
        ("seed=0.5", ["seed = 0.5"]),
        ("learner.bob.learning_rate=nan", ["learner.bob.learning_rate = 'nan'"]),
        ("learner.device=tpu", ["learner.device = 'tpu'"]),
        ("name=../escape", ["name = '../escape'"]),
        ("policy.alice.hidden_sizes=[64,0]", ["policy.alice.hidden_sizes.1 = 0"]),
        ("policy.bob.log_std_min=0.5", ["policy.bob: log_std_min 0.5"]),
        ("policy.alice_log_std_min=0.5", ["policy: alice_log_std_min 0.5"]),
        ("world.workspace.height_m=0.02", ["world: ", "lies 0.025 m high, and the workspace ends at 0.02 m"]),
        ("world.object={shape: mesh, mesh: {pieces: a.stl}}", ["world.object.mesh.pieces = 'a.stl'"]),
        ("world.object={shape: mesh, mesh: {pieces: [a.stl], scale: 0}}", ["world.object.mesh.scale = 0"]),
        ("game=3", ["game = 3"]),
        ("game.bob_margin_m=0.05", ["game: bob_margin_m 0.05 must be less than success_distance_m 0.05"]),
        ("generator.goal_source=hers", ["generator.goal_source = 'hers'", "alice, reached, uniform"]),
        (
            "learner.bob_help_max_success=1.5",
            ["learner.bob_help_max_success = 1.5", "less than or equal to 1"],
        ),
        ("world.object_mass_kg=100", ["less than or equal to 5 (kg)"]),
        ("world.object={shape: cone, size_m: [0.05]}", ["world.object.shape = 'cone'"]),
        ("world.object={shape: cylinder, size_m: [0.05]}", ["size_m of a cylinder has 2 numbers", "height; got 1"]),
        ("world.object={shape: capsule, size_m: [0.05, 0.04]}", ["length 0.04 must exceed its diameter"]),
        ("world.object={shape: sphere, size_m: [50]}", ["world.object.size_m.0", "less than or equal to 0.5 (metres)"]),
        ("world.object={shape: sphere, size_m: [0.05], color: [1, 2, 0]}", ["color.1", "less than or equal to 1"]),
        ("world.fixtures=[{shape: box, size_m: [0.05, 0.05, 0.05]}]", ["world.fixtures.0.position_m", "is missing"]),
        ("game={num_worlds: 0, num_goals: 0}", ["game.num_worlds = 0", "(and 1 more)"]),
        ("world.fixtures={shape: box}", ["world.fixtures"]),
        (f"world.obstacles=[{', '.join(['{shape: sphere, size_m: [0.02]}'] * 9)}]", ["world.obstacles", "at most 8"]),
        ("world.obstacles=[{shape: sphere, size_m: [0.05], mass_kg: 0}]", ["mass_kg = 0", "greater than 0"]),
        ("world.observed.obstacles=true", ["observed.obstacles", "describe some"]),
        ("world.randomisation.friction=[1, 0.5]", ["friction = [1, 0.5] is the wrong way round"]),
        ("world.randomisation.delay_steps=[0, 20]", ["delay_steps = [0, 20] goes beyond [0, 8]"]),
        (
            "world.randomisation.table_height_m=[-0.04, 0]",
            ["table_height_m begins at -0.04", "let it begin at -0.025 or higher"],
        ),
        ("world.randomisation.object_mass_kg=[0, 1]", ["object_mass_kg = [0, 1] goes beyond"]),
        (
            "world={fixture: wall, fixtures: [{shape: sphere, size_m: [0.05], position_m: [0, 0]}]}",
            ["the one or the other"],
        ),
    ],
)
def test_a_mistake_is_one_line_that_names_it(override, said):
    text = message(overrides=["seed=1", override])
    for words in said:
        assert words in text


@pytest.mark.parametrize(("source", "replay_invalid"), [("alice", True), ("reached", True), ("uniform", False)])
def test_without_alice_goals_come_from_elsewhere(source, replay_invalid):
    given = [
        "game.alice_plays=false",
        f"generator={{goal_source: {source}, replay_invalid: {str(replay_invalid).lower()}}}",
    ]
    assert "without Alice there are no goals: set generator.goal_source=uniform and" in message(overrides=given)


def test_the_file_is_named_in_its_errors(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("game: {num_goals: -2}\n")
    text = message(path)
    assert str(path) in text
    assert "game.num_goals = -2" in text


def test_missing_file(tmp_path):
    path = tmp_path / "none.yaml"
    text = message(path)
    assert str(path) in text
    assert "tandem configs lists" in text


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a: [1", "YAML"),
        (b"\xff\xfe\x00", "YAML"),
        (b"- 1\n- 2\n", "list"),
        (b"just words", "str"),
        (b"seed: 1\nseed: 2\n", "'seed' is there 2"),
    ],
)
def test_a_file_that_is_no_configuration(tmp_path, content, said):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    text = message(path)
    assert str(path) in text
    assert said in text


def test_a_directory_is_no_file(tmp_path):
    assert str(tmp_path) in message(tmp_path)


def test_every_shipped_configuration_loads():
    robots = set(CONFIGS.glob("robots/*.yaml"))
    paths = sorted(set(CONFIGS.rglob("*.yaml")) - robots)
    assert paths, "no configuration ships in configs/"
    for path in paths:
        load_config(path)
    assert robots
    for path in robots:  # their models are in packages that need not be installed
        assert RobotConfig.model_validate(parse_yaml(path.read_bytes(), path)).model.startswith("package:")


def test_self_imitation_of_turns_that_no_reward_reaches_is_refused():
    how = ["learner.self_imitation.weight=0.2", "learner.self_imitation.min_reward=11"]
    with pytest.raises(ConfigError, match=r"min_reward = 11, but no turn of Alice's pays more than 6, ") as error:
        load_config(None, how)
    assert len(str(error.value)) < 500  # not the whole configuration
    load_config(None, [*how, "game.alice_novelty_reward=5"])


def test_a_run_of_before_may_say_that_a_skill_is_held_for_one_step():
    config, directory = small_trial("lsd"), Path("run")
    assert small_trial("lsd", skill_steps=1) == config
    saved = config.model_dump(mode="json")
    assert changed_settings({**saved, "skill_steps": 1}, config, directory) == {}
    with pytest.raises(ConfigError, match="unknown key 'skill_steps'"):
        small_trial("lsd", skill_steps=5)


def test_a_task_that_goes_on_stays_in_its_world_unless_another_is_named():
    saved, given = small_trial(world={"friction": 0.5}), small_trial(world={"friction": 0.6})
    assert (small_trial().as_in(saved), given.as_in(saved)) == (saved, given)


@pytest.mark.parametrize(
    ("positions", "turns", "symmetric"),
    [
        ([(0.0, 0.0)], [0.0], True),
        ([(0.0, 0.0)], [0.3], False),
        ([(0.1, 0.1), (0.1, -0.1)], [0.3, -0.3], True),
        ([(0.1, 0.1), (0.1, -0.1)], [0.3, 0.3], False),
        ([(0.1, 0.1), (0.1, -0.1)], [0.3, math.pi - 0.3], True),  # half a turn more is the same box
        ([(0.1, 0.1), (0.0, -0.1)], [0.0, 0.0], False),
    ],
)
def test_which_fixtures_are_their_reflection(positions, turns, symmetric):
    box = {"shape": "box", "size_m": (0.1, 0.06, 0.04)}
    placed = [box | {"position_m": at, "turn_rad": turn} for at, turn in zip(positions, turns, strict=True)]
    assert WorldConfig(fixtures=placed).is_symmetric is symmetric


def test_a_source_whose_goals_nobody_would_play_is_refused():
    for source in ("uniform", "mine.py:Mine"):
        words = f"generator.goal_source = '{source}', but none of its goals would be played: set"
        assert words in message(overrides=[f"generator={{goal_source: '{source}'}}"])
