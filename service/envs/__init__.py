"""The MuJoCo world: scene, controller, observations, batches of worlds, Gymnasium environments. Importing it is cheap."""
