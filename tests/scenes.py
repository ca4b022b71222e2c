"""Expectations for the engine's tests: real stars on the nominal payload, or on a part of its pixels."""

from __future__ import annotations

from typing import Any

from mauvecl.host.expectation import Expectation, expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.sky.zodiacal import Sky
from mauvecl.host.stars.source import Source


def instrument(name: str = "mauve", *, part: bool = False, **changes: Any) -> Instrument:
    """The payload, or 198 of its pixels around the peak of the throughput, which the slow twin can afford."""
    if part:
        changes = {"output_min_nm": 300.0, "output_max_nm": 360.0} | changes
    found = Instrument.load(name)
    return found.with_(**changes) if changes else found


def star(
    name: str = "G2V",
    magnitude: float = 7.4,
    *,
    amplitudes: tuple[float, ...] = (),
    exposure: float = 50.0,
    payload: Instrument | None = None,
) -> list[Expectation]:
    """The quiescent star, then its flares."""
    payload = payload or instrument()
    quiet = Source.from_library(name).at_magnitude(magnitude)
    sources = [quiet, *(quiet.flaring(a) for a in amplitudes)]
    return [expect(s, payload, exposure=exposure, sky=Sky.of_brightness(22.1)) for s in sources]
