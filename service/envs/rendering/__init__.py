"""Pictures of a world: the renderer, and what is drawn besides the physics."""
