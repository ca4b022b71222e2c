"""Description of a store of raw spectra: groups, arrays, calibration and study."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.size_limits import read_bytes
from mauvecl.host.version import VERSION
from mauvecl.schema.errors import InputError
from mauvecl.study.messages import collect_messages as messages_of

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.store.stored_scenes import StoredScene
    from mauvecl.study.study import Study

#: Units of the calibration per pixel and frame, which each star's group contains.
CALIBRATION = {
    "wavelength_nm": "nm",
    "bias_dn": "DN",
    "dark_dn": "DN",
    "read_noise_dn": "DN",
    "gain_dn_per_electron": "DN / electron",
}
COMMON_DRAWS = (
    "row i of every array is drawn with the same random numbers, so that a flare is the only difference between two "
    "arrays; rows of different number are independent"
)
NOMINAL = "the throughput is nominal, not a flight calibration"

#: Attributes of a star that stores of earlier versions do not have.
LATER_ATTRIBUTES = ("instrument", "saturation_dn", "dark_unit", "temperature_c")


def without_later_attributes(described: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a group as earlier versions wrote it."""
    attributes = described.get("attributes", {})
    return described | {"attributes": {k: v for k, v in attributes.items() if k not in LATER_ATTRIBUTES}}


def without_version(described: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a group without the version that wrote it, which may be any."""
    attributes = described.get("attributes", {})
    return described | {"attributes": {k: v for k, v in attributes.items() if k != "mauvecl"}}


def describe(study: Study, scenes: Sequence[StoredScene], folder: Path) -> None:
    """Write groups, descriptions of arrays and calibration of a store to a folder."""
    import zarr
    from zarr.codecs import Crc32cCodec

    text, rows = study.toml(), study.run.realisations
    with warnings.catch_warnings():
        # Zarr warns of an empty folder.
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
        root = zarr.open_group(folder, mode="w", zarr_format=3)
        run: dict[str, Any] = signed(text) | {"seed": study.run.seed, "realisations": rows}
        root.attrs.update(run | {"mauvecl": VERSION, "draws": COMMON_DRAWS, "throughput": NOMINAL})
        for scene in scenes:
            x, group = scene.expectation, root.require_group(scene.group)
            if scene.name == "quiescent":
                group.attrs.update({"star": scene.star, **scene.at})
                group.attrs.update(exposure_attributes(x) | {"messages": messages_of([x])})
                for name, unit in CALIBRATION.items():
                    _values(group, name, np.asarray(getattr(x, name)), unit, ["pixel"])
                if scene.frames is not None:
                    _values(group, "frame", np.array(scene.frames), "", ["frame"])
            if study.bulk.components:
                n = x.n_frames if scene.frames is None else 1
                gain = n * x.gain_dn_per_electron
                for name, values in (
                    ("source", gain * x.source_electrons),
                    ("sky", gain * x.sky_electrons),
                    *([("neighbours", gain * x.neighbour_electrons)] if x.neighbour_electrons.any() else []),
                    ("noise", np.sqrt(x.variance_dn2 * n / x.n_frames)),
                ):
                    _values(group, f"{scene.name}-{name}", values, "DN", ["pixel"])
            dimensions = ["realisation", *(["frame"] if scene.frames is not None else []), "pixel"]
            array = group.create_array(
                scene.name,
                shape=(rows, *scene.row),
                chunks=(scene.chunk_rows(rows), *scene.row),
                dtype=scene.dtype,
                compressors=[Crc32cCodec()],
                fill_value=0,
                dimension_names=dimensions,
            )
            origin: dict[str, Any] = {"star": scene.star, "provenance": dict(x.provenance)} | signed(text)
            array.attrs.update(origin | {"units": "DN", "amplitude": scene.amplitude})


def exposure_attributes(x: Expectation) -> dict[str, float | str]:
    """Return the attributes that describe the exposure in every row of an array."""
    known: dict[str, float | str] = {"exposure_s": x.exposure_s, "frames": x.n_frames, "instrument": x.instrument}
    known |= {"saturation_dn": float(x.saturation_dn), "dark_unit": x.dark_unit}
    return known | ({"temperature_c": x.conditions["temperature_c"]} if "temperature_c" in x.conditions else {})


def _values(group: Any, name: str, values: NDArray[Any], unit: str, dimensions: list[str]) -> None:
    from zarr.codecs import Crc32cCodec

    array = group.create_array(
        name, data=values, chunks=values.shape, compressors=[Crc32cCodec()], dimension_names=dimensions
    )
    array.attrs["units"] = unit


def signed(study: str) -> dict[str, str]:
    """Return a study's text and its digest, of which a store has several copies."""
    return {"study": study, "study_sha256": hashlib.sha256(study.encode()).hexdigest()}


def study_in(place: Path) -> str | None:
    """Return the study's text in a description if its digest is correct, else None."""
    try:
        kept = json.loads(read_bytes(place, "description"))["attributes"]
        text = kept["study"]
        return text if signed(text).items() <= kept.items() else None
    except (InputError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
