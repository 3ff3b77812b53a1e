"""The pages about running on a cluster, from the recorded files in ``docs/results``.

    python -m benchmarks.cluster_figures --docs docs

Every block of ``results/cluster.md`` and ``scaling.md`` between two markers is written anew, with two pictures; the
words around the blocks stay. Whether a target was reached is computed. What was not recorded says so.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import cluster_tables, scaling_tables
from benchmarks.pages import Page
from benchmarks.pictures.cluster import draw_chaos, draw_soak
from service.errors import TandemError

BENCHMARKS = ("cluster_throughput", "chaos", "rest_load", "soak", "scaling")
PROGRAM = "benchmarks/cluster_figures.py"
CHAOS_PICTURE, SOAK_PICTURE = "cluster-chaos.png", "cluster-soak.png"


def read_results(results: Path) -> dict[str, dict[str, Any]]:
    """Recorded files by the name of their benchmark; what is not there is left out.

    Raises:
        TandemError: one cannot be read, or is another benchmark's.
    """
    found = {}
    for name in BENCHMARKS:
        path = results / f"{name}.json"
        if not path.exists():
            continue
        try:
            result = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TandemError(f"cannot read {path}: {error}; make it with benchmarks/{name}.py") from error
        if not isinstance(result, dict) or result.get("benchmark") != name:
            raise TandemError(f"{path} is not what benchmarks/{name}.py writes; make it anew")
        found[name] = result
    return found


def cluster(docs: Path, found: dict[str, dict[str, Any]]) -> list[Path]:
    """``results/cluster.md`` and its pictures.

    Raises:
        TandemError: the page lacks a marker, or something cannot be written.
    """
    results = docs / "results"
    blocks = {"targets": cluster_tables.targets_table(found), "throughput": "", "chaos": "", "rest": "", "soak": ""}
    files = [results / "cluster.md"]
    page = Page(files[0], PROGRAM)
    if (throughput := found.get("cluster_throughput")) is not None:
        blocks["throughput"] = cluster_tables.throughput_block(throughput)
    if (chaos := found.get("chaos")) is not None:
        blocks["chaos"] = cluster_tables.chaos_block(chaos, CHAOS_PICTURE)
        files.append(draw_chaos(chaos, results / CHAOS_PICTURE))
    if (rest := found.get("rest_load")) is not None:
        blocks["rest"] = cluster_tables.rest_block(rest)
    if (soak := found.get("soak")) is not None:
        blocks["soak"] = cluster_tables.soak_block(soak, SOAK_PICTURE)
        files.append(draw_soak(soak, results / SOAK_PICTURE))
    page.rewrite(blocks)
    return files


def scaling(docs: Path, found: dict[str, dict[str, Any]]) -> list[Path]:
    """``scaling.md``.

    Raises:
        TandemError: the page lacks a marker, or cannot be written.
    """
    page, result = Page(docs / "scaling.md", PROGRAM), found.get("scaling")
    makers = {
        "bottleneck": scaling_tables.limits_block,
        "box": scaling_tables.box_block,
        "nodes": scaling_tables.nodes_block,
        "model": scaling_tables.model_block,
        "constants": scaling_tables.constants_block,
    }
    page.rewrite({name: maker(result) if result is not None else "" for name, maker in makers.items()})
    return [page.path]


def main() -> int:
    """Parse the command line, draw, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, metavar="DIR", default=Path("docs"), help="(default: %(default)s)")
    given = parser.parse_args()
    try:
        found = read_results(given.docs / "results")
        files = [*cluster(given.docs, found), *scaling(given.docs, found)]
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(map(str, files)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
