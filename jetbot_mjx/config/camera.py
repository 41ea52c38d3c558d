"""Define the section `camera`: image, mount and lens."""

import math
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator

from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import Count, Positive, integral


class CameraConfig(Section):
    """The robot's camera, for `task.observation: camera`."""

    width: Annotated[int, BeforeValidator(integral), Field(ge=8, le=512)] = 32
    """[pixels] width of the image."""
    height: Annotated[int, BeforeValidator(integral), Field(ge=8, le=512)] = 32
    """[pixels] height of the image."""
    colour: Literal["rgb", "grey"] = "rgb"
    """`rgb`: three channels; `grey`: one."""
    frames: Annotated[int, BeforeValidator(integral), Field(ge=1, le=8)] = 1
    """Images that the policy sees, stacked along the channels, the newest last."""
    samples: Annotated[int, BeforeValidator(integral), Field(ge=1, le=8)] = 2
    """Rays per side of a pixel."""
    position: tuple[float, float, float] = (0.018, 0.0, 0.059)
    """[m] optical centre ahead of, left of and above the axle midpoint. The JetBot's CAD has the
    lens 15 to 19 mm ahead of the axle and 92 mm above the floor."""
    pitch: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] = 20.0
    """[deg] angle by which the camera looks down; 20 in the JetBot's CAD."""
    lens: Literal["pinhole", "opencv", "fisheye"] = "pinhole"
    """`opencv` and `fisheye`: OpenCV's two models of a lens with distortion."""
    fovy: Annotated[float, Field(ge=1, le=178, allow_inf_nan=False)] = 115.0
    """[deg] vertical field of view, without `matrix`. The JetBot's wide lens has 160 degrees from
    corner to corner, 113 from side to side of a square image; NVIDIA's own simulation uses 115."""
    matrix: tuple[Positive, Positive, float, float] | None = None
    """[pixels] fx, fy, cx, cy of a calibrated camera; null: `fovy`, the axis in the middle."""
    calibration_size: tuple[Count, Count] | None = None
    """[pixels] width and height of the images of the calibration; null: those above."""
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order: k1, k2, p1, p2, k3 to k6, or of a fisheye k1 to k4."""
    impl: Literal["auto", "llvm", "ptx", "xla"] = "auto"
    """How an image is compiled, as in `physics.impl`."""

    @field_validator("position", "matrix", "calibration_size", "distortion", mode="before")
    @classmethod
    def _as_tuple(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _known_lens(self) -> Self:
        most = {"pinhole": 0, "opencv": 8, "fisheye": 4}[self.lens]
        if len(self.distortion) > most:
            raise ValueError(
                f"distortion has {len(self.distortion)} coefficients: lens = {self.lens} takes at"
                f" most {most}"
            )
        if self.calibration_size is not None and self.matrix is None:
            raise ValueError(
                f"calibration_size = {list(self.calibration_size)} is that of a matrix, and there"
                " is none: give both, or only fovy"
            )
        values = [*self.position, *self.distortion, *(self.matrix or ())]
        if not all(map(math.isfinite, values)):
            raise ValueError("position, matrix and distortion should be finite numbers")
        return self
