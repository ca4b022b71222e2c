"""The verbs that look at a star: one observation, its signal to noise, the exposure for a wanted one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from mauvecl.cli.flags import DRAWS, FEWER, SIGNAL
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("flare", *SIGNAL, "run.seed", draws=False)
def simulate(
    study: Study,
    session: Session,
    given: dict[str, Any],
    realisation: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Which realisation to show.")] = 0,
) -> None:
    """Simulate one observation, and show what it consists of.

    Star, sky, photon noise, dark, bias, read noise, and the closed-form S/N.

    Example: mauvecl simulate --star G2V --magnitude 7.4 --exposure 50 --amplitude 0.24
    """
    from mauvecl.answers.signal.simulate import simulate as compute

    answer = compute(study, realisation=realisation, flaring=bool(given["amplitude"]))
    session.answer(answer)


def _budgets_or_star(given: dict[str, Any]) -> Study:
    """Return the paper's noise budgets if no flag names anything else, or else the paper's stars."""
    from mauvecl.study.study import PAPER_BUDGETS, Study

    named = any(given[name] for name in ("star", "magnitude", "exposure", "sweep"))
    return Study() if named else PAPER_BUDGETS


@takes_study(*DRAWS, *SIGNAL, "signal.wavelength_nm", "sweep", defaults=FEWER, default=_budgets_or_star)
def snr(
    study: Study,
    session: Session,
) -> None:
    """Compute signal-to-noise ratios and noise budgets.

    Of each pixel and of each resolution element (10.5 nm).

    The signal is the star's alone: the sky is subtracted, and its photons are noise (`--signal paper`: signal as well).

    Without arguments: the three stars of the paper's noise budgets, 50 s and 600 s.

    Examples: mauvecl snr --star B2IV --magnitude 3.03 --exposure 5

    mauvecl snr --star G2V --sweep magnitude=4,6,8,10 --sweep exposure=5,50,600
    """
    session.answer(session.ask(study))


@takes_study("signal", *SIGNAL, without="observation.exposure_s", draws=False)
def exposure(
    study: Study,
    session: Session,
) -> None:
    """Find the shortest exposure with a wanted S/N at a wavelength.

    By the closed form, in whole frames; `mauvecl snr` goes the other way.

    Example: mauvecl exposure --snr 10 --at 300 --star G2V --magnitude 7.4
    """
    session.answer(session.ask(study))
