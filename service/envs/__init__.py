"""The MuJoCo world: scene, controller, observations, batches of worlds, Gymnasium environments.

Importing this package is cheap; it only keeps a wrong ``MUJOCO_GL`` from breaking the import of MuJoCo later.
"""

from service.envs.rendering import gl

gl.protect_import()
