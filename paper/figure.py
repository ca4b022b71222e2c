"""Draw the figure of the paper: which flares of a G2V star Mauve would see. Run: python paper/figure.py."""

from pathlib import Path

from mauvecl import Engine, Study, map

study = Study.build(
    {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "observation": {"exposure_s": 50.0},
        "map": {"x": {"quantity": "magnitude", "start": 6.0, "stop": 12.0, "steps": 16}},
        "run": {"realisations": 100_000, "seed": 1, "fap": 1e-3, "statistics": ["matched"]},
    },
    "figure",
)
map(study, Engine()).plot(Path(__file__).parent / "figure.png")
