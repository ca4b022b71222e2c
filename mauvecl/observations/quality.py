"""Quality flags of missions, whose bits exclude a frame or are only noted."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

#: Bits of SAP_QUALITY by number: Kepler Archive Manual (KDMC-10008-006, table 2-3), K2 Archive Manual.
KEPLER = {
    1: "AttitudeTweak", 2: "SafeMode", 4: "CoarsePoint", 8: "EarthPoint", 16: "ZeroCrossing", 32: "Desat",
    64: "Argabrightening", 128: "ApertureCosmic", 256: "ManualExclude", 1024: "SensitivityDropout",
    2048: "ImpulsiveOutlier", 4096: "ArgabrighteningOnCCD", 8192: "CollateralCosmic", 16384: "DetectorAnomaly",
    32768: "NoFinePoint", 65536: "NoData", 131072: "RollingBandInAperture", 262144: "RollingBandInMask",
    524288: "PossibleThrusterFiring", 1048576: "ThrusterFiring",
}  # fmt: skip
#: Bits of QUALITY by number: TESS Science Data Products Description (EXP-TESS-ARC-ICD-0014 Rev F, table 32).
TESS = {
    1: "AttitudeTweak", 2: "SafeMode", 4: "CoarsePoint", 8: "EarthPoint", 16: "Argabrightening", 32: "Desat",
    64: "ApertureCosmic", 128: "ManualExclude", 256: "Discontinuity", 512: "ImpulsiveOutlier",
    1024: "CollateralCosmic", 2048: "Straylight", 4096: "Straylight2", 8192: "PlanetSearchExclude",
    16384: "BadCalibrationExclude", 32768: "InsufficientTargets",
}  # fmt: skip
NAMES: Mapping[str, Mapping[int, str]] = {"Kepler": KEPLER, "TESS": TESS}
#: Bits that exclude a frame by default: the default masks of lightkurve 2.6; of that for TESS without ImpulsiveOutlier,
#: which can mark flares and is noted.
DEFAULTS = {"Kepler": 1_130_799, "TESS": 17_087 & ~512}
NOTED = {"TESS": 512}
ALL_BITS = 2**62 - 1


@dataclass(frozen=True)
class QualityBits:
    """Bits of a quality flag that exclude a frame."""

    mask: int = ALL_BITS
    mission: str = ""  # whose names the bits have; empty if they have none
    noted: int = 0  # bits that are reported, though they do not exclude a frame

    @classmethod
    def of(cls, header: Mapping[str, Any], chosen: str | int | None, what: str) -> QualityBits:
        """Return the bits that are chosen for a file, or the defaults of its mission.

        Parameters
        ----------
        chosen : str or int, optional
            A sum of bits; "all" or "none"; or names and numbers, such as "Desat, 128". By default lightkurve's default
            for Kepler and K2, the same without ImpulsiveOutlier for TESS, and all bits for other files.
        """
        said = {str(header.get(key, "") or "").strip().upper() for key in ("TELESCOP", "MISSION")}
        mission = "Kepler" if said & {"KEPLER", "K2"} else "TESS" if "TESS" in said else ""
        if chosen is None or str(chosen).strip().lower() == "default":
            return cls(DEFAULTS.get(mission, ALL_BITS), mission, NOTED.get(mission, 0))
        return cls(_mask(chosen, NAMES.get(mission, {}), what), mission)

    def excluded(self, quality: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which frames a chosen bit excludes."""
        return np.asarray((np.asarray(quality, np.int64) & self.mask) != 0)

    def words(self, value: int) -> str:
        """Return the bits of a flag that exclude the frame, as in "Desat (32), NoData (65536)"."""
        value = int(value) & self.mask
        names = NAMES.get(self.mission, {})
        bits = [1 << k for k in range(value.bit_length()) if value >> k & 1]
        return ", ".join(f"{names[bit]} ({bit})" if bit in names else str(bit) for bit in bits)

    def remarks(self, quality: NDArray[Any], name: str) -> tuple[str, ...]:
        """Return the remark on frames that have a noted bit and are kept."""
        flags = np.asarray(quality, np.int64)
        n = int(np.count_nonzero((flags & self.noted != 0) & ~self.excluded(flags)))
        if not n:
            return ()
        bits = QualityBits(self.noted, self.mission).words(self.noted)
        frames = "1 frame of" if n == 1 else f"{n} frames of"
        verb = "is" if n == 1 else "are"
        return (f"{frames} {name} with the quality flag {bits} {verb} kept, because it can mark flares",)


def decimal_flags(flags: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return flags as numbers; those that lightkurve 2 writes into CSV are the digits of binary numbers."""
    finite = flags[np.isfinite(flags)]
    if not (finite.size and finite.max() >= 2**32):
        return flags
    texts = {value: f"{value:.0f}" for value in np.unique(finite).tolist()}
    if any(set(text) - {"0", "1"} for text in texts.values()):
        return flags
    return np.array([float(int(texts[value], 2)) if value in texts else value for value in flags.tolist()])


def _mask(chosen: str | int, names: Mapping[int, str], what: str) -> int:
    """Return the sum of the bits that a text or number chooses."""
    by_name = {name.lower(): bit for bit, name in names.items()}
    words = [word for word in re.split(r"[\s,;|+]+", str(chosen).strip()) if word]
    known = ", ".join(names.values())
    expected = "all, none, default, or numbers" + (f" and names among {known}" if known else
                                                   "; names are known for Kepler, K2 and TESS")  # fmt: skip
    if len(words) == 1 and words[0].lower() in ("all", "none"):
        return ALL_BITS if words[0].lower() == "all" else 0
    mask = 0
    for word in words:
        if word.isascii() and word.isdigit() and len(word) < 19:
            mask |= int(word)
        elif word.lower() in by_name:
            mask |= by_name[word.lower()]
        else:
            raise InputError.of("quality_bits", word, expected, where=what)
    if not words:
        raise InputError.of("quality_bits", chosen, expected, where=what)
    return mask
