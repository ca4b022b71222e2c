"""Study files of earlier versions give the same study, and the same text."""

from __future__ import annotations

import tomllib

from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.lightcurve.stares.curves import Curve
from mauvecl.study.study import Study

#: Written by the version in which limits, curves and cooling had classes for their text.
OLDER = """
[[star]]
library = "M3V"
magnitude = 9.0

[stare]
duration_s = 600.0
orbit_s = 5680.0

[stare.thermal]
amplitude = 0.5
phase = 1.0

[stare.sky]
points = [[0.0, 0.0], [600.0, 0.1]]

[[events]]
peak_s = 100.0
peak = 0.5
temperature_k = 12000.0

[events.cooling]
end_k = 6000.0
fold_s = 300.0

[orbit.limits]
earth_limb_deg = 20.0
sun_deg = "none"
moon_deg = "None"
declination_deg = "none"
normal_cone_deg = 39.1
anomaly = [[-90.0, -50.0], [40.0, -50.0], [0.0, 0.0]]
"""


def test_older_study_gives_domain_classes() -> None:
    study = Study.build(tomllib.loads(OLDER), "text")
    assert study.orbit.limits == Limits(
        earth_limb_deg=20,
        sun_deg=None,
        moon_deg=None,
        declination_deg=None,
        normal_cone_deg=39.1,
        anomaly=((-90, -50), (40, -50), (0, 0)),
    )
    assert study.stare.thermal == Curve(amplitude=0.5, phase=1.0)
    assert study.stare.sky == Curve(points=((0, 0), (600, 0.1)))
    assert study.events[0].cooling is not None
    assert study.events[0].cooling.end_k == 6000.0


def test_written_study_keeps_the_keys_of_older_versions() -> None:
    written = tomllib.loads(Study.build(tomllib.loads(OLDER), "text").toml())
    given = tomllib.loads(OLDER)
    assert written["orbit"]["limits"] == Study().orbit.limits.model_dump(mode="json") | given["orbit"]["limits"] | {
        "moon_deg": "none"
    }
    assert written["stare"]["thermal"] == given["stare"]["thermal"]
    assert written["stare"]["sky"] == {"phase": 0.0} | given["stare"]["sky"]
    assert written["events"][0] == {"energy": "bolometric"} | given["events"][0]
    assert Study.build(written, "text") == Study.build(given, "text")
