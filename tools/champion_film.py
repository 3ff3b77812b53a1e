"""The moving picture at the head of README: the bundled champion goes from one random goal to the next.

    python -m tools.champion_film docs/images/champion.gif

The object is never put back: what is seen is one game without a cut.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from service.envs.rendering.camera import View
from service.envs.rendering.renderer import Image, SceneRenderer
from service.media.encoding import encode
from service.play.cast import Cast, cast_primitives
from service.play.game import Game

PRIMITIVES, SEED = "panda-cube@champion", 6
WIDTH, HEIGHT, NUM_STEPS, STEPS_PER_FRAME = 480, 320, 250, 2
VIEW = View(146.0, -19.0, 1.5, (-0.10, 0.0, 0.17))


def main() -> int:
    """Draw it."""
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    cast = cast_primitives(PRIMITIVES, Path("registry"))
    step_s = cast.world.physics_step_s * cast.world.num_substeps
    path = encode(_frames(cast), Path(sys.argv[1]), fps=1 / (step_s * STEPS_PER_FRAME))
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0


def _frames(cast: Cast) -> Iterator[Image]:
    game = Game(cast, SEED)
    with SceneRenderer(cast.world, WIDTH, HEIGHT, VIEW) as renderer:
        for step in range(NUM_STEPS):
            if step % STEPS_PER_FRAME == 0:
                yield renderer.render(game.state, game.goal)
            game.step()
    game.close()


if __name__ == "__main__":
    raise SystemExit(main())
