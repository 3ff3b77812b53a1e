"""The paper's results, to print beside ours (table of downstream success rates; 16 episodes x 3 seeds, likely)."""

from __future__ import annotations

from collections.abc import Mapping

PAPER: Mapping[str, Mapping[str, float]] = {
    method: dict(zip(("larger", "inair", "push", "sphere", "wall", "box"), rates, strict=True))
    for method, rates in {
        "ours": (0.83, 1.00, 0.52, 1.00, 0.98, 0.98),
        "asp-only": (0.94, 0.94, 0.02, 0.85, 0.00, 0.27),
        "scratch-monolithic-her": (0.58, 0.94, 0.85, 1.00, 0.00, 0.36),
        "scratch-mcp-her": (0.85, 0.52, 0.92, 0.98, 0.00, 0.00),
        "scratch-monolithic": (0.02, 0.00, 0.00, 0.00, 0.00, 0.00),
        "scratch-mcp": (0.00, 0.00, 0.04, 0.00, 0.02, 0.00),
    }.items()
}
"""Success rate by method and task."""

BEST: Mapping[str, float] = {"larger": 0.94, "inair": 1.00, "push": 0.92, "sphere": 1.00, "wall": 0.98, "box": 0.98}
"""Of all the paper's methods, skill discovery included."""
