"""Privileged distillation: what the teacher is asked, what is learned of it, and that a resumed run is the same run."""

import numpy as np
import pytest
import torch

from service.actors.distillation import _LEAST_LOG_WEIGHT, _NOISY_SHARE, DistillationWorlds, Lesson
from service.base.errors import ConfigError, TandemError
from service.config import parse_config
from service.config.distillation import DistillationConfig
from service.envs.batch import WorldBatch
from service.envs.observations import BOB, PAPER, POSITIONS, layouts
from service.envs.overlap import inside_obstacles
from service.learner.distillation import Distiller
from service.learner.transfer import BOB_INPUTS, take_over
from service.methods.distillation import Distillation
from service.policies import networks
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.registry.loading import Trained, load
from service.registry.publishing import publish_run
from service.registry.registry import Registry
from service.runs.train import open_run
from service.store.run_directory import RunDirectory
from tests.cli.typed import tandem
from tests.runs.runs import TREE, assert_one_line, assert_same_run, play, read_lines, tiny_config

HOW = {"num_worlds": 8, "episode_steps": 6, "gradient_steps": 3, "batch_size": 16}


def config_of(randomisation, how=None, **run):
    world = TREE["world"] | {"observed": {"num_commands": 2, "delay": True}, "randomisation": randomisation}
    tree = {"name": "robust", "method": "distillation", "world": world, "policy": TREE["policy"]}
    tree |= {"distillation": HOW | (how or {}), "run": TREE["run"] | run}
    return parse_config(tree, where="a test")


def make_teacher(config, seed=0):
    torch.manual_seed(seed)
    return networks.make_bob(config.policy)


def make_student(config, teacher):
    student = networks.make_bob(config.policy, layouts(config.world))
    parameters = networks.export_parameters(teacher)
    take_over(student, parameters, PAPER, layouts(config.world), BOB_INPUTS)
    return student, NumpyMCPPolicy(parameters)


def test_labels_are_the_teachers_answers_when_the_command_counts():
    """Two steps late: the label of step t is the answer in the state of step t + 2, seen without errors."""
    drawn = {"delay_steps": [2, 2], "object_offset_m": [0.02, 0.02]}
    config = config_of(drawn, {"random_fraction": 0.0, "action_noise": 0.0})
    student, teacher = make_student(config, make_teacher(config))
    worlds = DistillationWorlds(config, teacher, PAPER, num_threads=1)
    played = worlds.play(NumpyMCPPolicy(networks.export_parameters(student)), np.random.default_rng(3))
    worlds.close()
    assert played.num_env_steps == 8 * (6 + 2)
    seen = layouts(config.world).bob
    rows = played.lesson.observation.reshape(6, 8, seen.size)
    answers = played.lesson.means.reshape(6, 8, *played.lesson.means.shape[1:])
    np.testing.assert_array_equal(rows[..., seen["delay"]], 2.0)
    with WorldBatch(config.world, 8, num_threads=1) as again:
        again.reset(np.random.default_rng(3))
        errors = again.states[:, again.layout["object_offset"]]
    for world, error in enumerate(errors):
        later = rows[2:, world, : POSITIONS.size].copy()
        wrong, _ = teacher.primitives(later)
        later[:, POSITIONS["object"]] -= error
        later[:, POSITIONS["object_from_effector"]] -= error
        expected, _ = teacher.primitives(later)
        np.testing.assert_allclose(answers[:4, world], expected, atol=2e-4)
        assert np.abs(answers[:4, world] - wrong).max() > 1e-3


def acting_student(config):
    torch.manual_seed(0)
    return NumpyMCPPolicy(networks.export_parameters(networks.make_bob(config.policy, layouts(config.world))))


def played_actions(config, student):
    """Observations (T, N, O) and actions (T, N, 4) of a round, and the worlds after it."""
    _, teacher = make_student(config, make_teacher(config))
    worlds = DistillationWorlds(config, teacher, PAPER, num_threads=1)
    actions, step = [], worlds._worlds.step
    worlds._worlds.step = lambda given: (actions.append(given.copy()), step(given))
    played = worlds.play(student, np.random.default_rng(1))
    worlds.close()
    seen = layouts(config.world).bob.size
    return played.lesson.observation.reshape(len(actions), -1, seen), np.stack(actions), worlds


def test_a_student_acts_with_noise_at_some_steps():
    config = config_of({}, {"num_worlds": 64, "random_fraction": 0.0, "action_noise": 0.1})
    student = acting_student(config)
    observation, actions, _ = played_actions(config, student)
    noise = actions - np.stack([student.act_deterministic(each) for each in observation])
    noisy = (np.abs(noise) > 1e-5).any(axis=-1)
    share = _NOISY_SHARE
    assert noisy.mean() == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) / noisy.size))
    assert noise[noisy].std() == pytest.approx(0.1, rel=0.15)
    assert (np.abs(noise[noisy]) > 1e-5).mean() > 0.99  # all four numbers at once


def test_random_weights_are_held():
    how = {"num_worlds": 64, "random_fraction": 0.9, "action_noise": 0.0, "episode_steps": 10}
    config = config_of({}, how)
    student = acting_student(config)
    observation, actions, worlds = played_actions(config, student)
    for step in range(5, 10):  # of ten; the weights of the last five are still there
        expected, _ = student.compose(observation[step][:, : layouts(config.world).positions.size], worlds._weights)
        random = np.isclose(actions[step], expected, atol=1e-6).all(axis=1)
        assert random.mean() == pytest.approx(0.9, abs=3 * np.sqrt(0.9 * 0.1 / 64))
    assert np.exp(_LEAST_LOG_WEIGHT) <= worlds._weights.min()
    assert 0.9 < worlds._weights.max() <= 1.0


def test_goals_are_outside_obstacles_and_diverged_worlds_are_told():
    """A big obstacle in a small workspace, and an object of which MuJoCo loses hold."""
    obstacle = {"shape": "box", "size_m": [0.06, 0.06, 0.3]}
    config = config_of({}, {"num_worlds": 64, "episode_steps": 2, "random_fraction": 0.0})
    world = config.world.model_dump(mode="json") | {"obstacles": [obstacle], "workspace": {"height_m": 0.3}}
    config = parse_config(config.model_dump(mode="json") | {"world": world}, where="a test")
    student, teacher = make_student(config, make_teacher(config))
    worlds = DistillationWorlds(config, teacher, PAPER, num_threads=1)
    batch, step = worlds._worlds, worlds._worlds.step

    def explode(actions):
        batch.states[:3, batch.layout["object_velocity"]] = 1e6
        return step(actions)

    batch.step = explode
    obstacles = []
    reset = batch.reset
    batch.reset = lambda rng: (reset(rng), obstacles.append(batch.obstacle_positions.copy()))
    played = worlds.play(NumpyMCPPolicy(networks.export_parameters(student)), np.random.default_rng(0))
    worlds.close()
    assert not inside_obstacles(played.goal, obstacles[0], config.world).any()
    assert len(played.diverged) == 3 * 2
    assert np.isfinite(played.lesson.observation).all()
    assert not batch.diverged


def test_errors_by_hand():
    """One primitive: the composition is its mean, whatever the weight."""
    config = config_of({})
    config = config.policy.model_copy(update={"bob": config.policy.bob.model_copy(update={"num_primitives": 1})})
    student = networks.make_bob(config)
    distiller = Distiller(student, DistillationConfig())
    observation = torch.randn(3, 14, generator=torch.Generator().manual_seed(0))
    means, variances = student.primitives(observation[:, :11])
    weights = student.gate(observation)
    means, variances, weights = (each.detach() for each in (means, variances, weights))
    assert [float(each) for each in distiller.errors(observation, means, variances, weights)] == [0.0, 0.0, 0.0]
    shifted = distiller.errors(observation, means + 0.5, variances * np.exp(2.0), weights * np.exp(0.3))
    assert float(shifted[0]) == pytest.approx(4 * 0.25, rel=1e-4)
    assert float(shifted[1]) == pytest.approx(4 * 0.25 + 4 * 1.0, rel=1e-4)
    assert float(shifted[2]) == pytest.approx(0.09, rel=1e-4)


def test_a_student_learns_what_a_late_teacher_would_do():
    """A teacher of other parameters: the student, who begins at random, comes nearer."""
    config = config_of({"delay_steps": [0, 2]}, {"num_worlds": 32, "gradient_steps": 30, "batch_size": 64})
    teacher = NumpyMCPPolicy(networks.export_parameters(make_teacher(config, seed=1)))
    torch.manual_seed(2)
    distiller = Distiller(networks.make_bob(config.policy, layouts(config.world)), config.distillation)
    worlds, rng = DistillationWorlds(config, teacher, PAPER, num_threads=1), np.random.default_rng(0)
    errors = []
    for _ in range(4):
        played = worlds.play(NumpyMCPPolicy(distiller.parameters()), rng)
        errors.append(distiller.learn(played.lesson, 0.0, rng)["primitives_error"])
    worlds.close()
    assert errors[-1] < 0.5 * errors[0]


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    root = tmp_path_factory.mktemp("taught")
    run, _ = play(root / "run", parse_config(TREE | {"run": TREE["run"] | {"total_env_steps": 200}}, where="a test"))
    run.close()
    return root, publish_run(run.directory, Registry(root / "registry"), run.config, run.method.parameters(), {})


def run_to_end(path, config, start=None, *, resume=False, stop_after=None):
    run = open_run(config, RunDirectory(path), resume=resume, start=start)

    def each(metrics):
        if metrics["iteration"] == stop_after:
            run.request_stop()

    run.run(each)
    run.close()
    run.directory.close()
    return run


def test_a_run_is_published_with_its_teacher_as_parent_and_is_exact_when_resumed(taught, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.media.video.write_episode_video", lambda *arguments: None)
    root, version = taught
    drawn = {"delay_steps": [0, 1], "object_noise_m": [0.0, 0.01], "friction": [0.5, 1.0], "num_models": 2}
    config = config_of(drawn, total_env_steps=220, evaluation_interval=2)
    start = load(str(version), root / "registry")
    whole = run_to_end(tmp_path / "whole", config, start)
    assert load(str(tmp_path / "whole")).alice is None
    filmed = tandem("render", tmp_path / "whole", "--episodes", "1")
    assert filmed.exit_code == 0, filmed.output
    run_to_end(tmp_path / "part", config, start, stop_after=2)
    run_to_end(tmp_path / "part", config, resume=True)
    assert_same_run(tmp_path / "part", tmp_path / "whole")
    assert whole.method.grid().cells
    assert {row["world/num_broken"] for row in read_lines(tmp_path / "whole" / "metrics.jsonl")} == {0.0}
    registry = Registry(root / "registry")
    published = publish_run(whole.directory, registry, config, whole.method.parameters(), {})
    assert registry.manifest(str(published)).parent == str(version)
    assert load(str(published), root / "registry").primitives.num_positions == 11 + 8 + 1


def test_a_run_of_distillation_can_be_begun_from_as_well(taught, tmp_path):
    """By self-play, or by distillation again: it has Bob's policy alone."""
    root, version = taught
    config = config_of({"delay_steps": [0, 1]}, total_env_steps=60)
    first = run_to_end(tmp_path / "first", config, load(str(version), root / "registry"))
    start = load(str(tmp_path / "first"))
    assert start.networks.keys() == {"bob/policy"}
    for name, array in first.method.parameters().items():
        np.testing.assert_array_equal(start.networks["bob/policy"][name], array)
    world = config.world.model_dump(mode="json") | {"obstacles": [{"shape": "box", "size_m": [0.06, 0.06, 0.1]}]}
    config = parse_config(config.model_dump(mode="json") | {"world": world}, where="a test")
    run_to_end(tmp_path / "again", config, start)  # among obstacles, which this teacher does not see


def a_lesson(student, gate_weight, num=8):
    """Where the student's primitives are right already, and his gate is asked for one weight."""
    observation = torch.randn(num, BOB.size)
    means, variances = (each.detach().numpy() for each in student.primitives(observation[:, : POSITIONS.size]))
    weights = np.full((num, means.shape[1]), gate_weight, np.float32)
    return Lesson(observation.numpy(), means, variances, weights)


def test_the_average_follows_and_the_learning_rate_falls_to_a_fiftieth():
    student, how = make_teacher(config_of({})), DistillationConfig(gradient_steps=1, batch_size=4)
    distiller, lesson, rng = Distiller(student, how), a_lesson(student, 0.5), np.random.default_rng(0)
    before = {name: parameter.detach().clone() for name, parameter in student.named_parameters()}
    distiller.learn(lesson, 0.0, rng)
    average = distiller.averaged_parameters()
    assert any((before[name] != parameter).any() for name, parameter in student.named_parameters())
    for name, parameter in student.named_parameters():
        expected = 0.9 * before[name] + 0.1 * parameter.detach()
        np.testing.assert_allclose(average[name], expected, atol=1e-6)
    rates = [distiller.learn(lesson, progress, rng)["learning_rate"] for progress in (0.5, 1.0, 3.0)]
    assert rates == pytest.approx([0.51e-3, 0.02e-3, 0.02e-3])


def test_the_gate_is_taught_where_the_action_says_nothing_of_it():
    """Of one primitive the composition has the same mean at any weight."""
    policy = config_of({}).policy
    policy = policy.model_copy(update={"bob": policy.bob.model_copy(update={"num_primitives": 1})})
    torch.manual_seed(0)
    student = networks.make_bob(policy)
    distiller = Distiller(student, DistillationConfig(gradient_steps=50, batch_size=8, learning_rate=1e-2))
    lesson, rng = a_lesson(student, 0.9), np.random.default_rng(0)
    first, last = (distiller.learn(lesson, 0.0, rng)["gate_error"] for _ in range(2))
    assert last < 0.2 * first


def test_what_is_published_before_anything_is_learned_is_the_teacher():
    teacher = config_of({})
    parameters = networks.export_parameters(networks.make_bob(teacher.policy, layouts(teacher.world)))
    learned = {"bob/policy": parameters}
    start = Trained("a test", "primitives", teacher, numpy_bob(parameters), parameters, networks=learned)
    method = Distillation(teacher.model_copy(update={"seed": 5}), start)
    method.start()
    found = method.parameters()
    method.close()
    for name, array in parameters.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"policy": TREE["policy"] | {"bob": TREE["policy"]["bob"] | {"num_primitives": 3}}}, "num_primitives=2"),
        ({"world": TREE["world"] | {"observed": {"num_commands": 1}}}, "raise world.observed.num_commands"),
    ],
)
def test_a_teacher_that_does_not_fit_is_refused(tmp_path, changed, said):
    teacher = config_of({})
    parameters = networks.export_parameters(networks.make_bob(teacher.policy, layouts(teacher.world)))
    learned = {"bob/policy": parameters}
    start = Trained("a test", "primitives", teacher, numpy_bob(parameters), parameters, networks=learned)
    config = parse_config(teacher.model_dump(mode="json") | changed, where="a test")
    with pytest.raises(TandemError, match=said) as error:
        open_run(config, RunDirectory(tmp_path / "run"), start=start)
    assert_one_line(error.value)


def test_without_a_teacher_and_what_goes_together(tmp_path):
    with pytest.raises(TandemError, match="name him, --from"):
        open_run(config_of({}), RunDirectory(tmp_path / "run"))
    with pytest.raises(ConfigError, match="distillation teaches primitives"):
        parse_config({"method": "distillation", "policy": {"monolithic_bob": {}}}, where="a test")


def test_the_teacher_of_a_run_of_self_play_is_its_averaged_bob(tmp_path):
    _, done = play(tmp_path / "played", tiny_config(total_env_steps=40))
    assert done is not None
    start = load(str(tmp_path / "played"))
    assert "alice/policy" in start.networks
    run = run_to_end(tmp_path / "taught", config_of({}, total_env_steps=60), start)
    for name, array in start.parameters.items():
        np.testing.assert_array_equal(run.method._teacher[name], array)
