"""Arms that nobody built: random serial chains."""

import mujoco
import numpy as np


def random_arm(kinds, seed):
    """A chain of ``hinge`` and ``slide`` joints with random frames, axes, anchors and reference values.

    Returns:
        The model, and the names of its joints from the base to the last link, which is called tip.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for index, kind in enumerate(kinds):
        name = "tip" if index == len(kinds) - 1 else f"link{index}"
        body = body.add_body(name=name, pos=rng.uniform(-0.3, 0.3, 3), quat=rng.normal(size=4))
        joint = mujoco.mjtJoint.mjJNT_HINGE if kind == "hinge" else mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(
            name=f"joint{index}", type=joint, axis=rng.normal(size=3), pos=rng.uniform(-0.1, 0.1, 3), ref=rng.normal()
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.05, 0, 0), mass=1.0)
    return spec.compile(), [f"joint{index}" for index in range(len(kinds))]
