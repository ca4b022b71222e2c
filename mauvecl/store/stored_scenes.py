"""Scenes of a study whose raw spectra a store holds, each as an array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.schema.tables import Column, percent
from mauvecl.study.labels import full_label

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.cases import Case

#: Approximate size of a chunk, bytes.
CHUNK_BYTES = 16 * 2**20


@dataclass(frozen=True, eq=False)
class StoredScene:
    """An array of a store: a star with or without a flare."""

    group: str
    name: str
    star: str
    amplitude: float
    expectation: Expectation
    frames: tuple[int, ...] | None
    at: Mapping[str, float | str]

    @property
    def path(self) -> str:
        """Path in the store."""
        return f"{self.group}/{self.name}"

    @property
    def row(self) -> tuple[int, ...]:
        """Shape of one realisation: pixels, or frames and pixels."""
        n_pixel = self.expectation.wavelength_nm.size
        return (n_pixel,) if self.frames is None else (len(self.frames), n_pixel)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a value: 16 bits for single frames of a 16-bit ADC, 32 bits for sums."""
        x = self.expectation
        single = self.frames is not None or x.n_frames == 1
        return np.dtype("<u2" if single and x.adc_max_dn < 2**16 else "<i4")

    @property
    def row_bytes(self) -> int:
        """Size of a realisation, bytes."""
        return int(np.prod(self.row)) * self.dtype.itemsize

    def chunk_rows(self, realisations: int) -> int:
        """Return the number of realisations per chunk."""
        return max(min(CHUNK_BYTES // self.row_bytes, realisations), 1)


#: Columns of the table of arrays.
ARRAY_COLUMNS = (
    Column("array", heading="array"),
    Column("star", heading="star"),
    Column("amplitude", heading="flare", format=percent("g")),
    Column("shape", heading="shape", format=lambda shape: " x ".join(map(str, shape))),
    Column("type", heading="type"),
)


def scenes(cases: Sequence[Case]) -> list[StoredScene]:
    """Return the arrays of the cases of a store: every star and sweep value, without and with each flare."""
    stored = []
    for number, case in enumerate(cases, 1):
        chosen = case.study.bulk.chosen(case.quiet.n_frames)
        # The amplitude is an attribute of the flare's array.
        swept = {name: value for name, value in case.at.items() if name != "amplitude"}
        name = full_label(case.label, swept)
        stored.append(StoredScene(f"star-{number}", "quiescent", name, 0.0, case.quiet, chosen, swept))
        for k, (amplitude, x) in enumerate(zip(case.amplitudes, case.flares, strict=True), 1):
            stored.append(StoredScene(f"star-{number}", f"flare-{k}", name, amplitude, x, chosen, swept))
    return stored
