"""What was learned downstream, from its directory, a registry and a service; and what is refused, in one line."""

import json
import shutil

import httpx
import numpy as np
import pytest

import service
from service.downstream.orchestrators import publish_orchestrator
from service.downstream.worker import RunOptions, run_trial
from service.envs.observations import layouts
from service.errors import TandemError
from service.primitives.bundled import BUNDLED
from service.primitives.verification import network_problems
from service.registry.registry import Registry
from service.robot.policies import for_robot
from tests.downstream.trials import small_trial
from tests.registry.helpers import files_in
from tests.status.conftest import serve


@pytest.fixture(scope="module")
def finished(tmp_path_factory, champion):
    """Directories of two trainings: of an orchestrator, and from nothing."""
    home = tmp_path_factory.mktemp("trainings")
    for method in ("ours", "scratch-monolithic"):
        run_trial(small_trial(method), champion, home / method, RunOptions(num_threads=1))
    return home


@pytest.fixture
def observation(champion):
    size = layouts(champion.config.world).bob.size
    return np.random.default_rng(0).uniform(-0.1, 0.2, (3, size)).astype(np.float32)


def acted(orchestrator, observation):
    """Actions of the first and the second step of episodes."""
    orchestrator.begin()
    return np.stack([orchestrator.act_deterministic(observation), orchestrator.act_deterministic(observation + 0.01)])


def refused(*arguments, **options):
    """The one line by which loading is refused."""
    with pytest.raises(TandemError) as refusal:
        service.load_policy(*map(str, arguments), **options)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


def test_it_acts_alike_from_its_directory_a_registry_and_a_service(finished, champion, observation, tmp_path):
    registry = tmp_path / "registry"
    local = service.load_policy(str(finished / "ours"), registry)
    expected = acted(local, observation)
    assert expected.shape == (2, 3, 4)
    assert (expected[0] != champion.policy.act_deterministic(observation)).any()
    assert (local.task, local.method, local.world.gripper) == ("push", "ours", "blocked")

    _, version = publish_orchestrator(finished / "ours", "push-orchestrator", registry)
    _, again = publish_orchestrator(finished / "ours", "push-orchestrator", registry)
    assert version == again == ("push-orchestrator", 1)
    manifest = Registry(registry).manifest("push-orchestrator")
    assert manifest.spaces["kind"] == "orchestrator"
    assert manifest.spaces["primitives"] == champion.manifest.reference
    result = json.loads((finished / "ours" / "result.json").read_text())
    assert manifest.metrics["evaluation/success_last"] == result["evaluation"]["success_last"]
    assert Registry(registry).verify(check=network_problems) == []
    published = service.load_policy("push-orchestrator@latest", registry)
    np.testing.assert_array_equal(acted(published, observation), expected)
    for reference, name in ((str(finished / "ours"), "push-ours-0"), ("push-orchestrator@latest", str(version))):
        found = service.load(reference, registry)
        assert found.name == name
        assert for_robot(found).world == found.nominal.world == local.world
        np.testing.assert_array_equal(found.player().act_deterministic(observation), expected[0])
    Registry(registry).export("push-orchestrator", tmp_path / "exported")
    exported = service.load_policy(str(tmp_path / "exported"), tmp_path / "no-registry")
    np.testing.assert_array_equal(acted(exported, observation), expected)

    (tmp_path / "runs").mkdir()
    with serve(tmp_path) as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        fetched = service.load_policy("push-orchestrator@latest", server.url)
        (listed,) = httpx.get(f"{server.url}/v1/primitives/push-orchestrator").json()["versions"]
    assert (listed["kind"], listed["task"]) == ("orchestrator", "push")
    assert listed["primitives"] == champion.manifest.reference
    assert fetched.label == "push-orchestrator@1"
    np.testing.assert_array_equal(acted(fetched, observation), expected)


def test_another_version_of_that_name_does_not_pass_for_its_primitives(finished, champion, observation, tmp_path):
    """A registry of one's own may have other primitives by the same reference: the digest decides."""
    own, number = Registry(tmp_path / "registry"), champion.manifest.version
    manifest, parameters = Registry(BUNDLED).load(str(champion.manifest.reference))
    parameters["gate.output.bias"] = parameters["gate.output.bias"] + np.float32(1.0)
    fields = {name: getattr(manifest, name) for name in ("spaces", "normalisation", "config", "metrics")}
    for _ in range(number):
        own.publish(manifest.name, parameters, **fields)
        parameters["gate.output.bias"] = parameters["gate.output.bias"] + np.float32(1.0)
    found = service.load_policy(str(finished / "ours"), own.root)
    assert found.trained.label == f"{champion.manifest.reference} (bundled)"

    reason = refused(finished / "ours", own.root, primitives=f"{manifest.name}@{number}")
    assert f"acts with {champion.manifest.reference} of digest" in reason
    assert f"{manifest.name}@{number} has other parameters" in reason
    assert "is not here: no 'nothing'" in refused(finished / "ours", own.root, primitives="nothing@1")


def test_orchestrators_and_primitives_are_not_taken_for_each_other(finished, champion, tmp_path, monkeypatch):
    registry = tmp_path / "registry"
    publish_orchestrator(finished / "ours", "push-orchestrator", registry)
    before = files_in(registry)
    for load in (service.load_primitives, service.load_skills):
        with pytest.raises(TandemError, match=f"@1 is a policy of the task push; {load.__name__} needs "):
            load("push-orchestrator@latest", registry)
    assert "is a set of primitives; load_policy needs a policy of a task" in refused("panda-cube@champion", registry)
    for name in (champion.manifest.name, "Push"):
        with pytest.raises(TandemError, match=r"panda-cube is the name of primitives already|bad name 'Push'"):
            publish_orchestrator(finished / "ours", name, registry)
    with pytest.raises(TandemError, match="the method scratch-monolithic learns no orchestrator"):
        publish_orchestrator(finished / "scratch-monolithic", "scratch", registry)
    with pytest.raises(TandemError, match="read only: publish in a directory"):
        publish_orchestrator(finished / "ours", "push-orchestrator", "http://127.0.0.1:9")
    assert files_in(registry) == before


def test_a_policy_from_nothing_needs_the_world_alone(finished, champion, observation, tmp_path):
    found = service.load_policy(str(finished / "scratch-monolithic"), tmp_path)
    assert acted(found, observation).shape == (2, 3, 4)
    for wrong, said in (
        (observation[:1], r"1 rows, and 3 in the step before: call begin\(\)"),
        (observation[0], "shape"),
    ):
        with pytest.raises(TandemError, match=said):
            found.act_deterministic(wrong)
    found.begin()
    assert found.act_deterministic(observation[:1]).shape == (1, 4)
    copy = shutil.copytree(finished / "scratch-monolithic", tmp_path / "copy")
    recorded = json.loads((copy / "cell.json").read_text())
    recorded["world"]["object_mass_kg"] = 0.3
    (copy / "cell.json").write_text(json.dumps(recorded))
    assert service.load(str(copy), tmp_path).world.object_mass_kg == 0.3
    assert "acts with no others" in refused(copy, tmp_path, primitives="panda-cube@champion")


def test_a_training_that_has_not_ended_or_is_damaged(finished, tmp_path):
    copy = shutil.copytree(finished / "ours", tmp_path / "copy")
    kept = (copy / "cell.json").read_text()
    for text, said in (("{", "is no JSON object"), ("{}", "lacks 'cell'")):
        (copy / "cell.json").write_text(text)
        assert said in refused(copy, tmp_path)
    changed = json.loads(kept)
    changed["primitives"]["env_steps"] = 1.0
    (copy / "cell.json").write_text(json.dumps(changed))
    assert "policy.safetensors is of another training than" in refused(copy, tmp_path)
    (copy / "cell.json").write_text(kept)
    (copy / "policy.safetensors").unlink()
    assert f"{copy} has ended, but its policy.safetensors is gone" in refused(copy, tmp_path)
    (copy / "result.json").unlink()
    assert f"{copy} has not ended: continue it with tandem downstream train --resume" in refused(copy, tmp_path)


def test_a_training_that_learned_nothing_plays_what_it_was_given(champion, tmp_path):
    for method, acts_with in (("asp-only", champion.label), ("idle", None)):
        run_trial(small_trial(method), champion, tmp_path / method, RunOptions(num_threads=1))
        found = service.load_policy(str(tmp_path / method), tmp_path)
        assert (found.trained.label if found.trained else None) == acts_with
        action = found.act_deterministic(np.zeros((1, layouts(found.world).bob.size), dtype=np.float32))
        assert (action == 0.0).all() == (method == "idle")
