"""JSON schemas of the API's answers, except those that the store and the registry define."""

from __future__ import annotations

from typing import Literal

from pydantic import AwareDatetime, Field

from service.frozen import FrozenModel
from service.registry.manifest import Manifest
from service.store.models import RunStatus


class Alive(FrozenModel):
    """Answer of a service that runs."""

    status: Literal["alive"] = "alive"


class Ready(FrozenModel):
    """Answer of a service that can read the runs and the registry."""

    status: Literal["ready"] = "ready"


class RunList(FrozenModel):
    """Runs, newest start first."""

    runs: tuple[RunStatus, ...]
    num_runs: int = Field(ge=0, description="that match the request, those over the limit included")


class MetricHistory(FrozenModel):
    """Metrics over iterations, in columns of equal length."""

    run_id: str
    last_iteration: int = Field(
        ge=0, description="of the newest record; 0 before the first. The after_iteration of the next request"
    )
    num_iterations: int = Field(ge=0, description="that match the request, before down-sampling")
    iteration: tuple[int, ...] = Field(description="the last iteration of each point")
    env_steps: tuple[int, ...] = Field(description="at that iteration")
    metrics: dict[str, tuple[float | None, ...]] = Field(
        description="by name, the mean over the iterations of a point; null if none of them has the metric"
    )
    names: tuple[str, ...] = Field(description="of all metrics the run has")


class RunFile(FrozenModel):
    """A picture or a video of a run."""

    name: str = Field(examples=["rounds.mp4"])
    title: str = Field(examples=["Alice beside Bob"])
    media_type: str = Field(examples=["video/mp4"])
    num_bytes: int = Field(ge=0)
    modified: AwareDatetime
    url: str = Field(description="path on this service", examples=["/v1/runs/cube/files/rounds.mp4"])


class RunFiles(FrozenModel):
    """The pictures and videos of a run."""

    files: tuple[RunFile, ...]


class PrimitiveSummary(FrozenModel):
    """A name in the registry."""

    name: str = Field(examples=["panda-cube"])
    num_versions: int = Field(ge=1)
    newest: int = Field(ge=1, description="the greatest version number")
    aliases: dict[str, int] = Field(description="the version of each alias", examples=[{"champion": 2, "latest": 3}])


class PrimitiveList(FrozenModel):
    """All names, sorted."""

    primitives: tuple[PrimitiveSummary, ...]


class VersionSummary(FrozenModel):
    """One version; the manifest has more."""

    version: int = Field(ge=1)
    kind: str = Field("primitives", description="what it is, such as `skills` or `orchestrator`")
    task: str | None = Field(None, description="of an orchestrator", examples=["push"])
    primitives: str | None = Field(None, description="NAME@VERSION of the primitives an orchestrator belongs to")
    created: str | None = Field(None, description="UTC, ISO 8601")
    metrics: dict[str, float] = Field(default_factory=dict)
    parent: str | None = Field(None, description="NAME@VERSION this one was trained on from")
    git_commit: str | None = None
    blob_sha256: str | None = None
    blob_bytes: int | None = None
    aliases: tuple[str, ...] = Field((), description="that point to this version now")
    problem: str | None = Field(None, description="why there is nothing else here: the manifest is damaged")


class PrimitiveVersions(PrimitiveSummary):
    """A name and its versions, newest first."""

    versions: tuple[VersionSummary, ...]


class ManifestDocument(Manifest):
    """The manifest of one immutable version, with its digest."""

    manifest_sha256: str = Field(
        pattern=r"^[0-9a-f]{64}$",
        description="of the other members as JSON with sorted keys, no white space, and ASCII escapes",
    )


class AliasChange(FrozenModel):
    """The version an alias shall point to."""

    version: int = Field(ge=1, le=1_000_000_000, examples=[1])


class AliasState(FrozenModel):
    """The version an alias points to now."""

    name: str
    alias: str
    version: int = Field(ge=1)
