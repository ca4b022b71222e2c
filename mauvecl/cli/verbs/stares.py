"""The command that draws stares: it has a device, and no pool."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import DeviceFlag
from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session


@command_of("stare", draws=False, resumes=True)
def stare(
    session: Session,
    given: dict[str, Any],
    device: DeviceFlag = None,
) -> None:
    """Draw stares on one device, which keeps their frames for a resume."""
    from mauvecl.answers.stares.stare import stare as compute
    from mauvecl.device.stare_engine import Stares
    from mauvecl.schema.errors import InputError

    if given["energy"] and (given["amplitude"] or given["flares"]):
        raise InputError("--energy is given together with --amplitude or --flares", "one of them", key="energy")

    stares = Stares(device)
    session.opened = stares.open_device
    with session.checkpoint() as checkpoint:
        answer = compute(session.study, stares, checkpoint=checkpoint)
    session.answer(answer)
