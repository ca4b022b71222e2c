"""Messages of answers about saturation, priors and the validity of closed forms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.noise.drawing import Cumulants, stack_is_exact
from mauvecl.noise.unknowns import PROCESSES
from mauvecl.schema.messages import Message, of_kind

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.noise.processes import Processes

#: Read noise, DN, above which rounding acts like independent noise at any signal: it damps the first harmonic of the
#: rounding error to exp(-2 pi^2) = 3e-9.
NOISY_DN = 1.0
#: Tolerance for the rounding of a prior's limits.
TINY = 1e-9
#: Kind of messages on saturation, and their largest number in an answer.
SATURATED = "saturated"
MAX_SATURATED = 12


def collect_messages(expectations: list[Expectation], processes: Processes | None = None) -> list[str]:
    """Return the messages of expectations and on the validity of closed forms, in the order of `worst_first`.

    All answers report the saturation of stars and flares through this function.
    """
    texts = [message for x in expectations for message in (*_without_light(x), *x.messages, *_coarse(x))]
    outside = off_centre(expectations, processes) if processes else []
    return worst_first([*(Message(f"OUTSIDE THE PRIOR: {text}.", "outside the prior") for text in outside), *texts])


def off_centre(expectations: list[Expectation], processes: Processes) -> list[str]:
    """Return a clause for each prior that excludes the value of an expectation."""
    sentences = []
    for name, _ in processes.modulations:
        first, last = getattr(processes, name).quantile(np.array([0.0, 1.0]))
        values = {PROCESSES[name].expected_in(x.conditions) for x in expectations}
        outside = sorted(value for value in values if not first - TINY <= value <= last + TINY)
        if outside:
            sentences.append(
                f"{name} is drawn from {first:g} to {last:g}, and the expectation, which is "
                f"subtracted, has {', '.join(f'{value:g}' for value in outside)}: every exposure differs from it, and "
                "thresholds hold that difference"
            )
    return sentences


def _without_light(x: Expectation) -> tuple[str, ...]:
    """Return the message on an exposure without light of the star, if it has none."""
    electrons = float(np.sum(x.source_electrons)) * x.n_frames
    if electrons >= 1.0:
        return ()
    return (
        Message(
            f"NO LIGHT: {x.name} gives {electrons:.2g} electrons in all {x.wavelength_nm.size} pixels of an exposure "
            f"of {x.exposure_s:g} s: there is nothing to see of it, and its S/N is 0.",
            "no light",
        ),
    )


def worst_first(messages: Iterable[str]) -> list[str]:
    """Remove duplicates, put messages on saturation first, and summarise these beyond `MAX_SATURATED`."""
    once = list(dict.fromkeys(messages))
    saturated = of_kind(once, SATURATED)
    others = [text for text in once if text not in set(saturated)]
    rest = len(saturated) - MAX_SATURATED
    if rest > 0:
        more = f"SATURATED: pixels of {rest} more stars, flares or exposures of this answer saturate."
        return [*saturated[:MAX_SATURATED], Message(more, SATURATED), *others]
    return [*saturated, *others]


def _coarse(x: Expectation) -> tuple[str, ...]:
    """Return the message on pixels for which rounding dominates, if any."""
    if float(np.min(x.read_noise_dn)) >= NOISY_DN:
        return ()
    pixels = int(np.count_nonzero(~stack_is_exact(Cumulants.of(x, 1), x)))
    if not pixels:
        return ()
    return (
        Message(
            f"In {pixels} of {x.wavelength_nm.size} pixels of {x.name} a frame has too little noise for its rounding "
            "to whole DN to be like noise: closed forms treat it as noise and are wrong there; simulations round each "
            "frame.",
            "rounding",
        ),
    )
