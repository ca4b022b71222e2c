"""The verbs that look at a star for hours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import SIZE, STARE, DeviceFlag
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("flare", *STARE, *SIZE, "run.seed", "sweep", without="observation.exposure_s", draws=False, resumes=True)
def stare(
    study: Study,
    session: Session,
    given: dict[str, Any],
    device: DeviceFlag = None,
) -> None:
    """Simulate a stare: light curves, spectra, flares, a search.

    Without arguments: the paper's two stars over one orbit, four flares each. The FITS files are read by lightkurve.

    Examples: mauvecl stare --star M3V --magnitude 9 --amplitude 0.5 --half-width 60 --thermal 0.5

    mauvecl stare --star G2V --magnitude 7.4 --distance 14.1 --energy 1e33 --energy 1e34 --orbit-gap 2100
    """
    from mauvecl.answers.stares.stare import stare as compute
    from mauvecl.device.stares import Stares
    from mauvecl.schema.errors import InputError

    if given["energy"] and (given["amplitude"] or given["flares"]):
        raise InputError("--energy is given beside --amplitude or --flares", "one of them", key="energy")

    stares = Stares(device)
    session.opened = stares.open_device
    with session.checkpoint() as checkpoint:
        answer = compute(study, stares, checkpoint=checkpoint)
    session.answer(answer)
