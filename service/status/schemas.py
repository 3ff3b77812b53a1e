"""JSON schemas of the API's answers, except those that the store and the registry define."""

from __future__ import annotations

from typing import Literal

from pydantic import AwareDatetime, Field, JsonValue

from service.config.frozen import FrozenModel
from service.registry.manifest import Manifest
from service.store.models import RunStatus
from service.store.run_log import LogLine

Axis = Literal["env_steps", "iteration", "wall_s"]
"""What a curve is drawn over: env steps, iterations, or seconds of learning."""
Origin = Literal["registry", "bundled"]
"""Whether primitives are in this service's registry, or came with its package."""


class ServiceState(FrozenModel):
    """That the service runs, that it can read runs and registry, or that a browser has its session."""

    status: Literal["alive", "ready", "open"]


class RunList(FrozenModel):
    """Runs, active ones first, then newest start first."""

    runs: tuple[RunStatus, ...]
    num_runs: int = Field(ge=0, description="that match the request, those over the limit included")
    sparklines: dict[str, tuple[float | None, ...]] = Field(
        {}, description="by run, the metric that was asked for with `sparkline`, in a few of its records"
    )


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


class Curve(FrozenModel):
    """One metric of a run, thinned; as long as the `x` of its run, null where there is no value."""

    mean: tuple[float | None, ...]
    low: tuple[float | None, ...] | None = Field(description="of each point; null if every iteration is a point")
    high: tuple[float | None, ...] | None


class RunSeries(FrozenModel):
    """Curves of one run."""

    run_id: str
    last_iteration: int = Field(ge=0, description="of the newest record, whatever part was asked for")
    num_iterations: int = Field(ge=0, description="that the points stand for")
    x: tuple[float, ...] = Field(description="on the axis, where each point ends")
    curves: dict[str, Curve] = Field(description="by the name of the metric")
    names: tuple[str, ...] = Field(description="of all metrics the run has")
    problem: str | None = Field(description="why there are no curves of this run")


class SeriesSet(FrozenModel):
    """The same metrics of several runs."""

    axis: Axis
    runs: tuple[RunSeries, ...] = Field(description="in the order of the request")


class RunCommand(FrozenModel):
    """A command for a shell on the machine of a run."""

    what: str = Field(description="what it does", examples=["Measure what it learned"])
    command: str


class RunSetup(FrozenModel):
    """What a run was started with, where it is, and the commands for it."""

    run_id: str
    directory: str | None = Field(description="on the machine of this service; null if it is on another")
    config: dict[str, JsonValue] | None = Field(description="resolved: with every default")
    problem: str | None = Field(None, description="why there is no configuration")
    stop_command: str | None = Field(description="for a shell on that machine")
    resume_command: str | None = Field(description="for a shell on that machine, once the run has ended")
    commands: tuple[RunCommand, ...] = Field((), description="what can be done with what it learned")


class TaskColumn(FrozenModel):
    """A downstream task."""

    task: str = Field(examples=["push"])
    version: int = Field(ge=0, description="of its Gymnasium name; different ones are not compared")
    title: str = Field(examples=["Push"])


class TaskCell(FrozenModel):
    """Success of a method on a task, at the last step of an episode."""

    task: str
    version: int
    success: float | None = Field(description="mean over seeds; null while none has ended")
    low: float | None = Field(description="of its 95 % interval: over seeds by Student's t, of one over its episodes")
    high: float | None
    num_seeds: int = Field(ge=0, description="that have ended; of two runs of one seed, the newer counts")
    run_ids: tuple[str, ...] = Field(description="of the runs that were averaged")
    unfinished: tuple[str, ...] = Field(description="ids of runs without a result")
    differs: dict[str, JsonValue] = Field(description="settings that other runs of this method have otherwise")


class TaskRow(FrozenModel):
    """A method, with the same primitives and world in all of its cells."""

    method: str = Field(examples=["ours-her"])
    title: str = Field(examples=["ours + HER"])
    primitives: str | None = Field(description="NAME@VERSION or directory of what it composes; null for nothing")
    primitives_digest: str | None
    cells: tuple[TaskCell, ...]


class TaskTable(FrozenModel):
    """Success of methods on tasks, from the runs of this service that learn one."""

    tasks: tuple[TaskColumn, ...]
    rows: tuple[TaskRow, ...]
    problems: tuple[str, ...] = Field(description="why runs are left out")


class RunLog(FrozenModel):
    """What happened to a run, oldest first."""

    entries: tuple[LogLine, ...] = Field(description="the newest that were asked for")
    num_entries: int = Field(ge=0, description="in all")
    output: tuple[str, ...] = Field((), description="last lines that a study's run wrote to its terminal")


class GoalFrame(FrozenModel):
    """Goals that Alice proposed in one part of a run, by cells."""

    first_env_steps: int = Field(ge=0)
    last_env_steps: int = Field(ge=0)
    num_goals: int = Field(ge=0, description="recorded, a sample of all")
    centers_m: tuple[tuple[float, float, float], ...] = Field(description="of the cells")
    num_tries: tuple[int, ...] = Field(description="goals in each cell")
    success_rate: tuple[float, ...] = Field(description="fraction of them that Bob reached")


class GoalFrames(FrozenModel):
    """How goals and their difficulty changed over a run."""

    cell_size_m: float = Field(gt=0)
    frames: tuple[GoalFrame, ...]


class TokenEntry(FrozenModel):
    """The token, as a person types it."""

    token: str = Field(min_length=1, max_length=4096)


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
    origins: tuple[Origin, ...] = Field(description="where its versions are")


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
    origin: Origin = Field("registry", description="the registry of this service, or what comes with tandem")
    directory: str = Field("", description="of that registry, on the machine of this service")
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

    version: int = Field(ge=1, le=1_000_000_000, strict=True, examples=[1])


class AliasState(FrozenModel):
    """The version an alias points to now."""

    name: str
    alias: str
    version: int = Field(ge=1)
