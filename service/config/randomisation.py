"""Ranges from which worlds draw what is not known exactly: the object, the arm, and how late and noisy all is."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from service.config.frozen import FrozenModel

Range = tuple[float, float]
"""Least and greatest value, all in between alike."""


class RandomisationConfig(FrozenModel):
    """Each start of a world draws anew, where there is a range; None leaves what the world says.

    What is part of the physics comes from a bank of models, made once, that cover the ranges evenly.
    """

    num_models: int = Field(
        32, ge=1, le=1024, description="in the bank; more cover the ranges more densely, and 64 cost 5 % of throughput"
    )
    object_size: Range | None = Field(None, description="factor of all sizes of the object")
    object_mass_kg: Range | None = Field(None)
    friction: Range | None = Field(None, description="sliding friction of the object, also on the table")
    gain: Range | None = Field(None, description="factor of the stiffness of the arm's servos")
    damping: Range | None = Field(
        None, description="factor of their damping; of the Panda's 0.4 to 1.7 cover 100 to 40 % of a step of 5 cm"
    )
    table_height_m: Range | None = Field(None, description="of the table and of what stands on it, above where it is")
    delay_steps: tuple[int, int] | None = Field(
        None, description="control steps until an action counts, drawn by game; let policies see as many commands"
    )
    object_noise_m: Range | None = Field(
        None, description="standard deviation of an object's seen position, each axis and step anew"
    )
    object_offset_m: Range | None = Field(
        None, description="length of an error of its seen position that stays for a game; its direction is any"
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        least = {"object_size": 0.2, "object_mass_kg": 1e-3, "friction": 0.01, "gain": 0.05, "damping": 0.05}
        most = {"object_size": 3.0, "object_mass_kg": 10.0, "friction": 5.0, "gain": 20.0, "damping": 20.0}
        least |= {"table_height_m": -0.05, "delay_steps": 0, "object_noise_m": 0.0, "object_offset_m": 0.0}
        most |= {"table_height_m": 0.05, "delay_steps": 8, "object_noise_m": 0.1, "object_offset_m": 0.1}
        for name in least:
            given = getattr(self, name)
            if given is None:
                continue
            low, high = given
            if low > high:
                raise ValueError(f"{name} = [{low:g}, {high:g}] is the wrong way round: give the lesser number first")
            if low < least[name] or high > most[name]:
                raise ValueError(f"{name} = [{low:g}, {high:g}] goes beyond [{least[name]:g}, {most[name]:g}]")
        return self

    @property
    def model_ranges(self) -> dict[str, Range]:
        """Those of the physics, by name."""
        names = ("object_size", "object_mass_kg", "friction", "gain", "damping", "table_height_m")
        return {name: given for name in names if (given := getattr(self, name)) is not None}
