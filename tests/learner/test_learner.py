from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from service.base.errors import ConfigError
from service.config import parse_config
from service.envs.observations import ACTION, BOB
from service.learner import ppo
from service.learner.learner import Learner, _rng_from_array, _rng_to_array, paid_well, solved_share, torch_device
from tests.generator.outcomes import make_records
from tests.learner.rollouts import make_config, make_rollout, nobody_learns

IMITATION = {"weight": 0.5, "num_iterations": 2, "min_reward": 0.5}
HISTORY = {"abc": {"num_iterations": 2}, "bob": {"mirror": "random"}, "self_imitation": IMITATION}

BOTH_PLAYERS = ("policy_loss", "value_loss", "entropy", "kl", "clip_fraction", "learning_rate")
BOTH_PLAYERS += ("explained_variance", "grad_norm", "policy_steps")
COMMON = ("num_alice_samples", "num_bob_samples", "num_demonstrations", "cloning_loss", "demonstration_log_ratio")
COMMON += ("demonstration_log_prob", "bob_std", "primitive_weight_0", "primitive_weight_1", "primitive_share_0")
COMMON += ("primitive_share_1", "non_finite_steps", "rollbacks", "version")
COMMON += ("policy_lag", "max_policy_lag")
NAMES = {f"learner/{player}_{name}" for player in ("alice", "bob") for name in BOTH_PLAYERS}
NAMES |= {f"learner/{name}" for name in COMMON}


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def updated(learner, sequence, **overrides):
    rollout = make_rollout(learner, sequence)
    assert learner.ingest(replace(rollout, **overrides))
    return learner.update()


def assert_same_state(first, second):
    first, second = first.state(), second.state()
    assert first.keys() == second.keys()
    for name, array in first.items():
        assert isinstance(array, np.ndarray)
        assert array.dtype == second[name].dtype
        assert array.shape == second[name].shape
        assert array.tobytes() == second[name].tobytes(), name


def test_one_update_learns_and_reports():
    learner = Learner(make_config())
    before = learner.weights()
    metrics = updated(learner, 0)
    after = learner.weights()
    assert metrics.keys() == NAMES
    assert (before.version, after.version, metrics["learner/version"]) == (0, 1, 1.0)
    assert any(not np.array_equal(before.alice[name], after.alice[name]) for name in before.alice)
    assert any(not np.array_equal(before.bob[name], after.bob[name]) for name in before.bob)
    assert metrics["learner/demonstration_log_ratio"] > 0.0
    assert metrics["learner/num_demonstrations"] == 12.0
    shares = sum(metrics[f"learner/primitive_share_{index}"] for index in range(2))
    assert shares == pytest.approx(1.0, abs=1e-5)


def test_the_average_of_bob_is_a_running_one():
    learner = Learner(make_config(bob_ema_decay=0.4))
    versions = [learner.weights().bob]
    for sequence in range(6):
        updated(learner, sequence)
        versions.append(learner.weights().bob)
    # keep 2/9, 3/10 and 4/11 of what was, then 0.4 (5/12 is more)
    for name in versions[0]:
        average = versions[0][name].astype(np.float64)
        for number, version in enumerate(versions[1:], start=1):
            keep = min(0.4, (1 + number) / (8 + number))
            average = keep * average + (1 - keep) * version[name]
        np.testing.assert_allclose(learner.weights().bob_ema[name], average, atol=1e-6)
    plain = Learner(make_config())
    updated(plain, 0)
    weights = plain.weights()
    assert all(weights.bob[name].tobytes() == each.tobytes() for name, each in weights.bob_ema.items())


def test_weights_are_copies():
    learner = Learner(make_config())
    weights = learner.weights()
    name = next(iter(weights.bob))
    weights.bob[name][...] = 7.0
    assert not np.array_equal(learner.weights().bob[name], weights.bob[name])


def test_the_seed_alone_decides_the_first_version():
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    first = Learner(make_config())
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.manual_seed(6)
    assert_same_state(first, Learner(make_config()))
    other = Learner(make_config().model_copy(update={"seed": 1}))
    names = [name for name in other.state() if name.startswith("alice/policy/") and name.endswith("weight")]
    assert all(not np.array_equal(first.state()[name], other.state()[name]) for name in names)


def test_a_rollout_counts_once():
    learner = Learner(make_config())
    rollout = make_rollout(learner, 3)
    assert learner.ingest(rollout)
    assert not learner.ingest(rollout)
    learner.update()
    assert not learner.ingest(replace(rollout, policy_version=1))
    assert not learner.ingest(replace(rollout, policy_version=1, sequence=2))
    assert learner.ingest(replace(rollout, policy_version=1, sequence=4))
    assert learner.ingest(replace(rollout, policy_version=1, incarnation=1, sequence=0))
    assert learner.ingest(replace(rollout, policy_version=1, actor=1, sequence=0))


def test_the_last_rollout_counts_whatever_the_order_of_arrival():
    learner = Learner(make_config())
    assert learner.ingest(make_rollout(learner, 4))
    assert learner.ingest(make_rollout(learner, 3))
    learner.update()
    assert learner.state()["counted"].tolist() == [[0, 0, 4]]
    assert not learner.ingest(make_rollout(learner, 4))


@pytest.mark.parametrize(("version", "taken"), [(0, False), (1, True), (2, True), (3, True), (4, False)])
def test_stale_rollouts_and_those_of_unknown_versions_are_refused(version, taken):
    learner = Learner(make_config())
    for sequence in range(3):
        updated(learner, sequence)
    assert learner.ingest(replace(make_rollout(learner, 9), policy_version=version)) is taken


def test_the_order_of_arrival_does_not_matter():
    learners = [Learner(make_config()) for _ in range(2)]
    rollouts = [replace(make_rollout(learners[0], 0, seed=actor), actor=actor) for actor in range(3)]
    for learner, order in zip(learners, (rollouts, rollouts[::-1]), strict=True):
        for rollout in order:
            learner.ingest(rollout)
    assert learners[0].update() == learners[1].update()
    assert_same_state(*learners)


def test_an_update_needs_a_rollout():
    learner = Learner(make_config())
    with pytest.raises(AssertionError, match="ingest"):
        learner.update()
    updated(learner, 0)
    with pytest.raises(AssertionError, match="ingest"):
        learner.update()


def test_resume_is_exact():
    straight, stopped, resumed = (Learner(make_config(**HISTORY)) for _ in range(3))
    for learner in (straight, stopped):
        updated(learner, 0)
        updated(learner, 1)
    resumed.load_state(load(save(stopped.state())))
    assert_same_state(resumed, stopped)
    for sequence in (2, 3):
        rollout = make_rollout(straight, sequence)
        for learner in (straight, resumed):
            assert learner.ingest(rollout)
        assert straight.update() == resumed.update()
    assert_same_state(straight, resumed)
    assert not resumed.ingest(make_rollout(resumed, 1))


@pytest.mark.parametrize("num_halves", [0, 1, 2])  # a draw of 32 bits leaves half a word behind
def test_a_loaded_generator_continues(num_halves):
    rng = np.random.Generator(np.random.PCG64(3))
    rng.integers(0, 1 << 32, num_halves, dtype=np.uint32)
    words = _rng_to_array(rng)
    loaded = _rng_from_array(words)
    assert words.dtype == np.uint64
    assert words.shape == (6,)
    for each in (rng, loaded):
        assert each.bit_generator.state["has_uint32"] == num_halves % 2
    np.testing.assert_array_equal(
        rng.integers(0, 1 << 32, 5, dtype=np.uint32), loaded.integers(0, 1 << 32, 5, dtype=np.uint32)
    )
    np.testing.assert_array_equal(rng.permutation(100), loaded.permutation(100))


def test_names_in_a_state_are_those_of_checkpoints_that_are_out_there():
    """Runs of this version go on, so none of these may be renamed before its next one."""
    learner = Learner(make_config())
    updated(learner, 0)
    parts = {"/".join(name.split("/")[:2]) for name in learner.state()}
    of_player = "adam", "configured_rate", "learning_rate", "policy", "value"
    players = {f"{player}/{part}" for player in ("alice", "bob") for part in of_player}
    kept = {f"demonstrations/{name}" for name in ("action", "num_steps", "observation")}
    average = {f"bob_ema/{name}" for name in learner.weights().bob}
    assert parts == players | kept | average | {"version", "rng", "counted"}


@pytest.mark.parametrize(("adapted", "expected"), [(1.2e-4, 6e-5), (5.9e-4, 2.95e-4), (9e-6, 4.5e-6)])
def test_half_of_the_learning_rate_is_half_of_the_one_that_was_adapted(adapted, expected):
    """From 3e-4 to 1.5e-4; bounds are 0.03 and 2 times the new one."""
    config = make_config()
    learner = Learner(config)
    learner._bob.optimizer.learning_rate = adapted
    half = config.learner.bob.model_copy(update={"learning_rate": 0.5 * config.learner.bob.learning_rate})
    lower = Learner(config.model_copy(update={"learner": config.learner.model_copy(update={"bob": half})}))
    lower.load_state(learner.state())
    assert lower._bob.optimizer.learning_rate == pytest.approx(expected)
    assert lower._alice.optimizer.learning_rate == learner._alice.optimizer.learning_rate
    before = {name: each for name, each in learner.state().items() if not name.endswith("configured_rate")}
    lower.load_state(before)  # of before this was saved
    assert lower._bob.optimizer.learning_rate == pytest.approx(min(adapted, 3e-4))


def test_a_state_is_a_copy():
    learner = Learner(make_config(**HISTORY))
    updated(learner, 0)
    state = learner.state()
    bytes_before = save(state)
    updated(learner, 1)
    assert save(state) == bytes_before


def test_rollouts_not_learned_from_are_not_part_of_a_state():
    learner, resumed = Learner(make_config()), Learner(make_config())
    rollout = make_rollout(learner, 0)
    assert learner.ingest(rollout)
    resumed.load_state(learner.state())
    assert resumed.ingest(rollout)


def test_demonstrations_of_the_last_iterations_are_kept():
    learner = Learner(make_config(**HISTORY))
    counts = []
    for sequence, num in enumerate((12, 5, 0, 0)):
        learner.ingest(make_rollout(learner, sequence, num_demonstrations=num))
        counts.append(learner.update()["learner/num_demonstrations"])
    assert counts == [12.0, 17.0, 5.0, 0.0]


def test_demonstrations_that_are_not_finite_are_left_out():
    learner = Learner(make_config())
    rollout = make_rollout(learner, 0)
    rollout.demonstrations.action[3, 1] = np.nan
    learner.ingest(rollout)
    metrics = learner.update()
    assert metrics["learner/num_demonstrations"] == 11.0
    assert metrics["learner/non_finite_steps"] == 0.0


def test_demonstrations_alone_are_cloned():
    learner = Learner(make_config(bob={"num_epochs": 5}, abc={"weight": 1.0}))
    metrics = updated(learner, 0, bob=nobody_learns(make_rollout(learner, 0).bob))
    assert metrics["learner/num_bob_samples"] == 0.0
    assert metrics["learner/demonstration_log_ratio"] > 0.01
    assert "learner/bob_policy_loss" not in metrics


def test_without_samples_or_demonstrations_a_player_stays():
    learner = Learner(make_config())
    before = learner.weights()
    rollout = make_rollout(learner, 0, num_demonstrations=0)
    metrics = updated(
        learner,
        0,
        alice=nobody_learns(rollout.alice),
        bob=nobody_learns(rollout.bob),
        demonstrations=rollout.demonstrations,
    )
    after = learner.weights()
    assert after.version == 1
    for name in before.alice:
        np.testing.assert_array_equal(before.alice[name], after.alice[name])
    assert metrics["learner/alice_learning_rate"] == 3e-4


def test_alice_clones_her_turns_that_were_paid_well():
    learner, plain = Learner(make_config(self_imitation=IMITATION)), Learner(make_config())
    rollouts = [make_rollout(learner, sequence) for sequence in range(3)]
    paid = [int(each.alice.active[:, each.alice.reward.sum(axis=0) >= 0.5].sum()) for each in rollouts]
    assert min(paid) > 0
    for sequence, rollout in enumerate(rollouts):
        learner.ingest(replace(rollout, policy_version=learner.version))
        metrics = learner.update()
        assert metrics["learner/num_imitated"] == sum(paid[max(0, sequence - 1) : sequence + 1])  # of two iterations
    assert metrics["learner/alice_demonstration_log_ratio"] > 0.0
    assert "learner/num_imitated" not in updated(plain, 0)
    again = Learner(make_config(self_imitation=IMITATION))
    updated(again, 0)
    pairs = [(each, again.weights().alice[name]) for name, each in plain.weights().alice.items()]
    assert any(not np.array_equal(*pair) for pair in pairs)


@pytest.mark.parametrize("rows_per_sample", [0.02, 4.0])
def test_a_few_imitated_turns_count_in_proportion(monkeypatch, rows_per_sample):
    weights, real = [], ppo.update
    monkeypatch.setattr(ppo, "update", lambda *given, **how: weights.append(given[3].weight) or real(*given, **how))
    learner = Learner(make_config(self_imitation=IMITATION | {"rows_per_sample": rows_per_sample}))
    metrics = updated(learner, 0)
    share = metrics["learner/num_imitated"] / (rows_per_sample * metrics["learner/num_alice_samples"])
    assert (share < 1.0) == (rows_per_sample == 4.0)
    assert weights[0] == pytest.approx(0.5 * min(share, 1.0))


def test_turns_of_past_players_and_badly_paid_ones_are_not_cloned():
    turns = make_rollout(Learner(make_config()), 0).alice
    reward = np.zeros_like(turns.reward)
    reward[0] = [9.0, 8.9, 9.0, 0.0, 4.0, 0.0, 0.0, np.nan]
    reward[1, 4] = 5.0  # with the first step's it is 9
    learn = np.array([True, True, False, True, True, True, True, True])
    found = paid_well(replace(turns, reward=reward, learn=learn), 9.0)
    expected = turns.active & np.isin(np.arange(8), [0, 4])
    np.testing.assert_array_equal(found.observation, turns.observation[expected])
    np.testing.assert_array_equal(found.action, turns.action[expected])


def test_cloning_can_be_switched_off():
    metrics = updated(Learner(make_config(abc={"weight": 0.0})), 0)
    assert "learner/cloning_loss" not in metrics
    assert metrics["learner/num_demonstrations"] == 0.0


def test_the_weight_of_cloning_is_that_of_the_configuration():
    log_ratios = []
    for weight in (0.1, 2.0):
        metrics = updated(Learner(make_config(abc={"weight": weight}, bob={"target_kl": 1.0})), 0)
        log_ratios.append(metrics["learner/demonstration_log_ratio"])
    assert log_ratios[1] > 1.5 * log_ratios[0] > 0.0


def test_how_many_of_his_turns_bob_solved():
    """Those of a past Bob, and those without a goal, are none of his."""
    goals = np.zeros((5, 3))
    first = make_records(goals, solved=[True, True, False, True, True], bob_past=[False] * 3 + [True] * 2)
    second = make_records(goals[:2], solved=[False, True], played=[True, False])
    learner = Learner(make_config())
    rollouts = [replace(make_rollout(learner, 0), records=records) for records in (first, second)]
    assert solved_share(rollouts) == 2 / 4
    assert solved_share([make_rollout(learner, 0)]) == 0.0


@pytest.mark.parametrize(("solved", "helped"), [([True, False], True), ([True, True, False], False)])
def test_bob_is_helped_until_he_solves_more_than_that(solved, helped):
    """Help is clones and mirrored samples; without it he learns as if the recipe had neither."""
    records = make_records(np.zeros((len(solved), 3)), solved=solved)
    some = Learner(make_config(bob={"mirror": "random"}, bob_help_max_success=0.5))
    other = Learner(make_config(**{"bob": {"mirror": "random"}} if helped else {"abc": {"weight": 0.0}}))
    metrics = [updated(learner, 0, records=records) for learner in (some, other)]
    assert ("learner/cloning_loss" in metrics[0]) == helped
    assert metrics[0]["learner/num_demonstrations"] > 0  # they are kept, as the next update may clone
    bobs = [learner.weights().bob for learner in (some, other)]
    assert all(np.array_equal(bobs[0][name], bobs[1][name]) for name in bobs[0])


def test_a_broken_turn_leaves_the_player_as_it_was():
    learner = Learner(make_config(bob={"num_epochs": 3}))
    rollout = make_rollout(learner, 0)
    step, world = np.argwhere(rollout.alice.active)[0]
    rollout.alice.observation[step, world, 0] = np.nan
    before = learner.weights()
    learner.ingest(rollout)
    metrics = learner.update()
    after = learner.weights()
    assert all(np.array_equal(before.alice[name], array) for name, array in after.alice.items())
    assert "learner/bob_policy_loss" in metrics
    assert metrics["learner/non_finite_steps"] >= 1.0
    assert any(not np.array_equal(before.bob[name], after.bob[name]) for name in before.bob)


@pytest.mark.skipif(torch.cuda.is_available(), reason="asking for CUDA is no mistake on a machine that has it")
def test_cuda_that_is_not_there_is_the_users_mistake():
    with pytest.raises(ConfigError, match=r"learner\.device=cpu"):
        Learner(make_config(device="cuda"))


@pytest.mark.parametrize(("found", "expected"), [(False, "cpu"), (True, "cuda")])
def test_the_device_is_what_there_is(monkeypatch, found, expected):
    monkeypatch.setattr("torch.cuda.is_available", lambda: found)
    assert torch_device("auto") == torch.device(expected)


def test_bob_is_mirrored_alone():
    plain, learner = Learner(make_config()), Learner(make_config(bob={"mirror": "random"}))
    rollout = make_rollout(learner, 0)
    rows = learner._to_clone("demonstrations", [rollout.demonstrations]).take(np.arange(24))
    np.testing.assert_array_equal(rows.observation[12:], BOB.mirror(rollout.demonstrations.observation))
    np.testing.assert_array_equal(rows.action[12:], ACTION.mirror(rollout.demonstrations.action))
    metrics, expected = updated(learner, 0), updated(plain, 0)
    for name in ("num_bob_samples", "num_demonstrations", "num_alice_samples"):
        assert metrics[f"learner/{name}"] == expected[f"learner/{name}"]
    found, before = learner.weights(), plain.weights()
    assert all(np.array_equal(each, before.alice[name]) for name, each in found.alice.items())
    assert any(not np.array_equal(each, before.bob[name]) for name, each in found.bob.items())


@pytest.mark.parametrize(
    ("world", "mirrored"),
    [
        ({}, True),
        ({"workspace": {"center_y_m": 0.05}}, False),
        (
            {"fixtures": [{"shape": "box", "size_m": [0.1, 0.06, 0.04], "position_m": [0.0, 0.1], "turn_rad": 0.3}]},
            False,
        ),
    ],
)
def test_only_what_is_alike_on_both_sides_is_mirrored(world, mirrored):
    config = parse_config(
        make_config(bob={"mirror": "random"}).model_dump(mode="json") | {"world": world}, where="a test"
    )
    learner = Learner(config)
    rollout = make_rollout(learner, 0)
    rows = learner._to_clone("demonstrations", [rollout.demonstrations])
    assert len(rows) == len(rollout.demonstrations.action) * (1 + mirrored)
    plain = Learner(parse_config(make_config().model_dump(mode="json") | {"world": world}, where="a test"))
    found, expected = (updated(each, 0)["learner/num_demonstrations"] for each in (learner, plain))
    assert found == expected
    same = all(np.array_equal(each, plain.weights().bob[name]) for name, each in learner.weights().bob.items())
    assert same is not mirrored
