"""Files and settings of trainings that are wrong: one line that names the place."""

import re

import numpy as np
import pytest

import service
from service.downstream.files import read_json
from service.downstream.settings import make_trial
from service.errors import TandemError
from service.registry.registry import Registry


@pytest.mark.parametrize("text", ["5", "[1]", "nonsense"])
def test_what_is_no_object(tmp_path, text):
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(
        TandemError, match=rf"^{re.escape(str(path))} is no JSON object: .*; remove it, or name another"
    ):
        read_json(path)


def test_a_setting_out_of_range():
    with pytest.raises(TandemError, match=r"^num_env_steps = 0: input should be greater than or equal to 1$"):
        make_trial(task="push", method="ours", num_env_steps=0)


def test_a_manifest_that_lacks_what_an_orchestrator_needs(tmp_path):
    spaces = {"kind": "orchestrator", "method": "ours", "task": "push", "primitives": "panda-cube@1"}
    nothing = {"normalisation": {}, "config": {}, "metrics": {}}
    Registry(tmp_path).publish("old", {"gate.weight": np.zeros(1, dtype=np.float32)}, spaces=spaces, **nothing)
    with pytest.raises(TandemError, match=r"^old@1: its manifest lacks 'primitives_digest'; publish it again$"):
        service.load_policy("old@latest", tmp_path)
