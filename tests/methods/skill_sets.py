"""Skills that nothing has learned, for tests."""

import torch

from service.config import WorldConfig
from service.config.skills import SkillDiscoveryConfig, SkillsConfig
from service.learner.sac_networks import GaussianActor, make_layers
from service.policies.frozen_skills import FrozenSkills, ZeroShotPolicy, export_skills
from service.policies.networks import export_parameters
from service.policies.numpy_actor import NUM_MOTION_INPUTS
from service.registry.loading import Trained

WORLD = WorldConfig(physics_step_s=0.005, num_substeps=8)
SIZE = 4
CONFIG = SkillDiscoveryConfig(name="made", world=WORLD, skills=SkillsConfig(method="lsd", size=SIZE))


def parameters(seed=5):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        actor, network = GaussianActor(NUM_MOTION_INPUTS + SIZE, 4, (16,)), make_layers(3, 8, SIZE)
    return export_skills(export_parameters(actor), export_parameters(network))


def made(method="lsd", seed=5):
    config = CONFIG.model_copy(update={"skills": SkillsConfig(method=method, size=SIZE)})
    arrays = parameters(seed)
    return Trained("made@1", "skills", config, ZeroShotPolicy(FrozenSkills(arrays, config.skills)), arrays)
