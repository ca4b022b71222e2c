"""Checks before a run starts: invalid values, endless runs, and full disks."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.store.layout import Store
    from mauvecl.study.study import Study

YEAR_S = 365.25 * 86_400.0
#: Pixel-realisations a second of one core, counted per scenario: the best of `bench/results/rates.ecsv`, 1.2e10 on two
#: cores with 16 scenarios, so that no feasible run raises an error.
CORE_RATE = 6e9
#: Assumed speed of a selected device, in cores: that of an accelerator.
DEVICE_RATE = 100 * CORE_RATE
#: Assumed number of cores of a cluster, as in the documentation's plan.
CLUSTER_CORES = 1000
#: The engine's index of realisations has 63 bits: `Engine._check`.
MOST_REALISATIONS = 2**63 - 1


def question_values(study: Study, *, detects: bool) -> None:
    """Raise InputError for values that a later step would reject.

    Parameters
    ----------
    detects : bool
        Whether the verb needs flares and thresholds.
    """
    from mauvecl.detection.fap_checks import check_fap
    from mauvecl.detection.names import check_statistic
    from mauvecl.host.instrument.paths import instrument_path
    from mauvecl.host.stars.band_names import known_band
    from mauvecl.host.stars.library import spectrum_name

    for star in study.star:
        if star.library is not None:
            spectrum_name(star.library)
        elif star.file is not None:
            _check_file(star.file)
        known_band(star.band)
    instrument_path(study.observation.instrument, Path())
    if not detects:
        return
    run = study.run
    known_band(study.flare.band)
    for name in run.statistics:
        check_statistic(name)
    check_fap(run.fap, run.realisations, run.tails)


def _check_file(file: Path) -> None:
    from mauvecl.host.files.size_limits import read_bytes
    from mauvecl.host.spectra.formats import without_columns

    try:
        place, _ = without_columns(file)
        there = place.is_file()
    except (OSError, ValueError):
        # The reader reports impossible names.
        return
    if not there:
        read_bytes(place, "spectrum file")


def question_time(study: Study, *, device: str | None, cluster: str | None, insist: bool) -> None:
    """Raise InputError for a study whose smallest number of draws takes more than a year; `insist` skips this check.

    The message contains the estimate and names `--insist`. More realisations than the index can count always raise it.
    """
    count = study.run.realisations
    if count > MOST_REALISATIONS:
        raise InputError.of("realisations", count, f"at most {MOST_REALISATIONS}: the index has 63 bits")
    if insist or count < 10**9:
        # A billion ends within hours on any device, so the instrument need not be loaded.
        return
    scenarios = 1 + len(study.flare.amplitudes)
    combinations = study.sweep.size
    drawn = count * len(study.star) * combinations * scenarios * study.observation.load_instrument().pixels
    rate, by = _rate(device, cluster)
    years = drawn / rate / YEAR_S
    if years > 1.0:
        raise InputError(
            f"realisations = {count:.3g} of {len(study.star) * combinations} stars draw {drawn:.2g} "
            f"pixels and take some {years:.2g} years at {rate:.2g} a second ({by})",
            "less than a year; --insist starts it anyway",
            key="realisations",
            value=count,
        )


def question_room(store: Store, *, insist: bool) -> None:
    """Raise InputError, with the required and the available space, for a store that does not fit on its disk."""
    if insist:
        return
    there = next(folder for folder in (store.path, *store.path.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(there).free + _held(store.path)
    if store.n_bytes > free:
        rows = free // (store.n_bytes // store.rows)
        raise InputError(
            f"realisations = {store.rows} take {_size(store.n_bytes)} and {str(store.path)!r} has room "
            f"for {_size(free)}",
            f"at most {rows} of them, or another place; --insist starts it anyway",
            key="realisations",
            value=store.rows,
        )


def _rate(device: str | None, cluster: str | None) -> tuple[float, str]:
    """Return the highest pixel-realisations per second, and the source of this rate."""
    cores = os.cpu_count() or 1
    if cluster is not None and not cluster.startswith("local:"):
        return CLUSTER_CORES * CORE_RATE, f"assumed of {CLUSTER_CORES} cores"
    if device is not None:
        devices = device.count(",") + 1
        return max(devices * DEVICE_RATE, cores * CORE_RATE), f"assumed of {devices} accelerators"
    return cores * CORE_RATE, f"the best measured on {cores} cores"


def _held(folder: Path) -> int:
    """Return the bytes that an unfinished store already has."""
    return sum(path.stat().st_size for path in folder.glob("star-*/*/c/*/*")) if folder.is_dir() else 0


def _size(size: float) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB"):
        if size < 1024:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} PiB"
