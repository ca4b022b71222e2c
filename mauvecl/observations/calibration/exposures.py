"""Frames of a calibration: raw spectra of a standard star, or frames without light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source

Float = NDArray[np.float64]

#: Share of saturation above which a mean raw level is not used, since clipping then changes mean and variance.
MOST_OF_SATURATION = 0.98


@dataclass(frozen=True, eq=False)
class CalibrationFrames:
    """Raw frames of one observation that have no fault."""

    name: str
    raw_dn: Float  # shape (n_frame, n_pixel); with bias and dark
    exposure_s: float  # of each frame
    temperature_c: Float  # shape (n_frame,); of the detector
    star: Source | None = None  # the known spectrum at its brightness; None for frames without light

    @classmethod
    def of(cls, frames: Frames, nominal: Instrument, star: Source | None, temperature_c: float | None = None) -> Self:
        """Select the good frames of spectra that a detector recorded.

        Parameters
        ----------
        frames : Frames
            Raw DN of each pixel that the instrument reads.
        temperature_c : float, optional
            Of the detector, where the frames do not state it.
        """
        nm = frames.wavelength_nm
        if nm is None or nm.shape != nominal.wavelength_nm.shape:
            raise InputError.of(
                "frames", frames.flux.shape, f"spectra of the {nominal.wavelength_nm.size} pixels that "
                f"{nominal.name} reads", where=frames.name,
            )  # fmt: skip
        off = float(np.abs(nm - nominal.wavelength_nm).max())
        if off > nominal.resolution_element_nm:
            raise InputError.of("wavelength", f"{off:.3g} nm from those of {nominal.name}",
                                f"at most {nominal.resolution_element_nm:g} nm", where=frames.name)  # fmt: skip
        unit = frames.unit.strip().casefold()
        if unit not in ("dn", "adu", "ct", "count"):
            raise InputError.of("unit", frames.unit or "none", "raw DN, with bias and dark", where=frames.name)
        if frames.net:
            raise InputError(
                f"{frames.name}: dark current and bias are subtracted",
                "raw DN: read_frames(..., raw=True)", key="frames",
            )  # fmt: skip
        temperatures = frames.temperature_c
        if temperatures is None:
            if temperature_c is None:
                raise InputError(f"{frames.name}: the temperature of the detector is not stated",
                                 "a column of temperatures, or temperature_c", key="temperature_c")  # fmt: skip
            temperatures = np.full(frames.n_frames, temperature_c)
        good = (frames.faults == 0) & np.isfinite(temperatures)
        lengths = np.unique(frames.exposure_s[good].round(6))
        if good.sum() < 3 or lengths.size != 1:
            raise InputError.of("frames", f"{int(good.sum())} good ones of {lengths.size} exposure times",
                                "at least 3 of one exposure time", where=frames.name)  # fmt: skip
        if (frames.flux[good] == frames.flux[good][0]).all():
            raise InputError.of("frames", "all the same", "frames that differ by their noise", where=frames.name)
        return cls(frames.name, frames.flux[good], float(lengths[0]), temperatures[good], star)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.raw_dn)

    def usable(self, nominal: Instrument) -> NDArray[np.bool_]:
        """Return the pixels that stay below saturation in every frame, shape (n_pixel,)."""
        ceiling = min(nominal.saturation_dn, nominal.adc_max_dn)
        return np.asarray(self.raw_dn.max(axis=0) < MOST_OF_SATURATION * ceiling)
