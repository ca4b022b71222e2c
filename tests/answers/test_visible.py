"""Visibility answers: tables agree with each other and with the host, and the calendar is valid."""

import icalendar
from scenes import paper

from mauvecl import visible


def test_messages_and_calendar_beyond_the_elements() -> None:
    names = ["eps Eri", "AU Mic", "EK Dra"]
    found = visible(paper(f"orbit.targets={names}", "orbit.start=2027-02-10T06:00", "orbit.days=40"))
    reported = " ".join(found.messages)
    assert "EK Dra is never seen: the limit of declination (-46.4 to 31.8 deg) alone leaves nothing" in reported
    assert "mean Sun-synchronous" in reported
    assert "Stray light is not modelled" in reported
    assert {"earth_limb_deg", "sun_deg", "moon_deg", "proton_flux"} <= set(found.assumptions["limit"])
    assert all("assumption" in source for source in found.assumptions["source"])
    events = icalendar.Calendar.from_ical(found.documents["visible.ics"]()).walk("VEVENT")
    assert {str(event["SUMMARY"]) for event in events} == {"eps Eri", "AU Mic"}
    for name in names:
        days_of = found.by_day[found.by_day["target"] == name]
        # Half an hour and more is shown as a day.
        seen = (days_of["hours"].value >= 0.5).sum()
        days = sum((e["DTEND"].dt - e["DTSTART"].dt).days for e in events if str(e["SUMMARY"]) == name)
        assert days == seen


def test_calendar_near_the_epoch_has_windows() -> None:
    answer = visible(paper("orbit.targets=['eps Eri']", "orbit.start=2026-09-20", "orbit.days=2"))
    events = icalendar.Calendar.from_ical(answer.documents["visible.ics"]()).walk("VEVENT")
    assert len(events) == answer.table["windows"][0] > 20
    first, windows = events[0], answer.windows[0]
    assert (first["DTEND"].dt - first["DTSTART"].dt).total_seconds() == windows.length_s[0]
    assert answer.messages == answer.messages[-1:]  # nothing of the orbit: its elements are a week old


def test_toml_dates_are_read() -> None:
    starts = {"2027-01-01": "01T00", "2027-01-01T06:00:00": "01T06", "2027-01-01T06:00:00+02:00": "01T04"}
    for text, found in starts.items():
        times = paper(f"orbit.start={text}").orbit.times()
        assert (times.iso(0.0), times.iso(0.5, 1)) == (f"2027-01-{found}:00:00", f"2027-01-{found}:00:00.5")
