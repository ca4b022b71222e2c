"""Run the snippets of README and documentation pages as written, in page order.

Each page has one folder and one Python namespace. Its Python blocks, its commands (indented lines that begin with
`mauvecl`) and its files (blocks of TOML whose first line names a file) run one after the other, after what the reader
brings (`BROUGHT`). Two things differ from what a reader does, and both are declared here: commands draw fewer
realisations (`REDUCED`), and some do not run (`NOT_RUN`).
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commands import run
from layouts import documented_files

from mauvecl import Study

ROOT = Path(__file__).parent.parent
#: Appended to a verb's flags, so that it ends in seconds: what it prints has the same form.
_FEWER = "--no-pictures -n 10000 --set run.fap=0.01"
_SHORT = "--no-pictures --set stare.duration_s=600"
_CELLS = (
    f"{_SHORT} -n 20 --set search.nulls=0 --set injections.sizes=2 --set injections.widths=2 --set injections.fitted=0"
)
REDUCED = {
    "simulate": "--no-pictures",
    "exposure": "--no-pictures",
    "snr": "--no-pictures -n 1000",
    "detect": _FEWER,
    "limit": f"{_FEWER} --statistic matched",
    "map": f"{_FEWER} --set map.x.steps=3 --set map.y.steps=3",
    "gaussian": f"{_FEWER} --sweep magnitude=6,8",
    "stare": f"{_SHORT} --no-search",
    "inject": _CELLS,
    "visible": "--no-pictures --days 5",
    "plan": "--no-pictures --days 5 --completeness 'closed form' --report html",
    "calibrate": "--no-pictures",
    "measure": "--no-pictures --fits 50",
    "devices": "--no-rate",
    "change": "--no-pictures --set change.trials=10 --set change.steps=2 --set change.period_fap=0.1",
    "realise": "-n 1000",
}
#: The same for commands whose own flags would contradict these.
INSTEAD = {
    "limit --star G2V --amplitude 0.24 --unknown": f"{_FEWER} --statistic matched --unknown 2",
    "inject --star G2V --magnitude 7.4 --sweep": f"{_CELLS} --as-list",
    "gaussian --star": f"{_FEWER} --sweep magnitude=6,8 --sweep exposure=5",
    "detect --fap 1e-8 --tails sampled": "--no-pictures -n 10000 --star G2V -m 7.4 -a 0.02 --statistic matched",
    "realise --star G2V --magnitude 7.4 --amplitude 0.24 --exposure 5": "-n 10000",
    "measure --star M3V --magnitude 9 --amplitude 2 --snr-per-bin": "--no-pictures --fits 10 --duration 400",
}
#: Python draws fewer as well.
FEWER = {"1_000_000": "100_000", "injections.count=100": "injections.count=20"}
#: Commands that do not run here, and why.
NOT_RUN = {
    r"serve": "runs until it is interrupted; tests/web starts the page's server",
    r"library fetch": "needs a network",
    r"selftest": "takes most of a minute; tests/device/test_selftest.py runs it",
    r"detect study\.toml --cluster (tcp|scheduler)": "needs a scheduler; tests/runs/test_cluster.py has one",
}
#: Python that does not run here, by a name in it, and why.
NOT_EXECUTED = {"tcp://host:8786": "needs a scheduler; tests/runs/test_cluster.py has one"}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPET = re.compile(r"^```(python|toml)\n(.*?)^```$|^    (mauvecl [^\n]*)$", re.DOTALL | re.MULTILINE)
#: What a process prints, not what a reader types.
OUTPUT = re.compile(r"mauvecl: ")

NM = np.linspace(170.0, 1150.0, 800)
FLUX = 1e-12 * np.exp(-(((NM - 560) / 250) ** 2))


def snippets(page: Path) -> Iterator[tuple[str, str]]:
    """Yield kind and text of every snippet of a page, in its order."""
    for kind, block, command in SNIPPET.findall(page.read_text(encoding="utf-8")):
        if command and OUTPUT.match(command) is None:
            yield "command", command
        elif kind == "python" or (kind == "toml" and re.match(r"# [\w.-]+\.toml\n", block)):
            yield kind, block


# What readers bring


def text(name: str, *columns: np.ndarray, head: str = "") -> None:
    np.savetxt(name, np.transpose(columns), header=head, comments="", delimiter=",")


def study_of_ones_own() -> None:
    stars = {"star": [{"library": "G2V", "magnitude": 9.0}], "run": {"statistics": ["chi2"]}}
    Path("study.toml").write_text(Study.build(stars, "test").toml())


def own_star() -> None:
    text("my-star.txt", NM, FLUX)


def tables(name: str, fluxes: tuple[str, ...], *extensions: str) -> None:
    columns = [fits.Column("WAVELENGTH", "D", unit="ANGSTROMS", array=10 * NM)]
    columns += [fits.Column(flux, "D", unit="FLAM", array=FLUX) for flux in fluxes]
    made = [fits.BinTableHDU.from_columns(columns, name=extension) for extension in extensions]
    fits.HDUList([fits.PrimaryHDU(), *made]).writeto(name)


def spectra() -> None:
    own_star()
    text("angstrom.txt", 10 * NM, FLUX)
    text("watts.txt", NM, FLUX / 100)
    text("from-290nm.txt", NM[NM > 290], FLUX[NM > 290])
    text("spectrum.csv", NM, NM + 1, FLUX, FLUX, head="wave_obs,wave_rest,model_flux,observed_flux")
    text("flares.csv", np.array([0.05, 0.1]), head="amplitude")
    tables("grid.fits", ("g40", "g45"), "")
    tables("two.fits", ("FLUX",), "SCI", "OTHER")
    targets = fits.Column("TARGETID", "K", array=[39627652591521181, 39627652591521182])
    hdus: list[fits.hdu.base.ExtensionHDU] = [fits.BinTableHDU.from_columns([targets], name="FIBERMAP")]
    for arm, low, high in (("B", 3600.0, 5800.0), ("R", 5760.0, 7620.0), ("Z", 7520.0, 9824.0)):
        wave = np.arange(low, high, 0.8)
        light = np.interp(wave / 10, NM, FLUX) * 1e17
        hdus += [
            fits.ImageHDU(wave, name=f"{arm}_WAVELENGTH"),
            fits.ImageHDU(np.array([light, light]), name=f"{arm}_FLUX"),
        ]
        hdus[-1].header["BUNIT"], hdus[-2].header["BUNIT"] = "10**-17 erg/(s cm2 Angstrom)", "Angstrom"
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto("coadd.fits")


def efficiency() -> None:
    Path("my-qe.ecsv").write_text(
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: wavelength, unit: nm, datatype: float64}\n"
        "# - {name: value, unit: A / W, datatype: float64}\nwavelength value\n150 0.1\n450 0.2\n1000 0.3\n"
    )


def stray_light() -> None:
    np.savetxt("stray-light.txt", np.transpose([NM, 1.0 + NM / 1000.0]))


def targets() -> None:
    """Write the table of targets that the page about plans shows."""
    page = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```\n(name,ra,.*?)```", page, re.DOTALL)
    Path("targets.csv").write_text(shown)


def observed_frames() -> None:
    """Write light curves: the one of the documentation, and a simulated one under two names."""
    for name in ("gj65_galex_nuv_5s.csv", "gj65.toml"):
        Path(name).write_bytes((ROOT / "tests" / "data" / "flares" / name).read_bytes())
    time = np.arange(300) * 60.0 / 86_400
    flux = np.random.default_rng(1).normal(100.0, 1.0, time.size)
    columns = [fits.Column("TIME", "D", unit="d", array=time), fits.Column("FLUX", "D", array=flux)]
    for name in ("frames.fits", "light-curve.fits"):
        fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(name)


def neighbours() -> None:
    """Write the table of neighbours that the page shows, one of the Gaia archive, and a light curve."""
    (shown,) = re.findall(r"```\n(name,sep.*?)```", (ROOT / "docs" / "neighbours.md").read_text(encoding="utf-8"), re.S)
    Path("near.csv").write_text(shown)
    head, rows = "designation,ra,dec,phot_g_mean_mag,bp_rp", ("1,150,60,8.1,2.3", "2,150,60.003,9,0.85")
    Path("gaia.csv").write_text("\n".join([head, *(f"Gaia DR3 {row}" for row in rows)]))
    observed_frames()


def spectra_of_au_mic() -> None:
    shutil.copytree(ROOT / "tests" / "data" / "flares" / "aumic_iue", "aumic_iue")


def observed_noise() -> None:
    """Write a light curve of Mauve with dates."""
    time, flux = np.arange(300) * 60.0, np.random.default_rng(1).normal(100.0, 1.0, 300)
    columns = [fits.Column("TIME", "D", unit="s", array=time), fits.Column("FLUX", "D", array=flux)]
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header.update({"MJDREF": 61_300, "TREFPOS": "TOPOCENTER", "INSTRUME": "mauve"})
    hdu.writeto("light-curve.fits")


def standards() -> None:
    """Write the study, the mapping and the frames of the page on standard stars."""
    names: dict[str, object] = {}
    for kind, snippet in snippets(ROOT / "docs" / "standard-star.md"):
        if kind == "command":
            return
        read_snippet(kind, snippet, names)


def files_of_the_checkout() -> None:
    """Provide the files that commands of the gallery name by their place in a checkout."""
    Path("tests").symlink_to(ROOT / "tests")


BROUGHT: dict[str, tuple[Callable[[], None], ...]] = {
    "README.md": (targets, observed_frames, standards),
    "gallery.md": (files_of_the_checkout,),
    "cluster.md": (study_of_ones_own,),
    "mapping.md": (observed_noise, lambda: documented_files(Path())),
    "long-runs.md": (study_of_ones_own,),
    "my-instrument.md": (efficiency,),
    "neighbours.md": (neighbours,),
    "my-star.md": (spectra,),
    "observations.md": (observed_frames, spectra_of_au_mic),
    "page.md": (study_of_ones_own,),
    "plan.md": (targets,),
    "tutorial.md": (own_star,),
    "unknowns.md": (stray_light,),
}


def reduced(command: str) -> list[str]:
    """Return the words of a command after `mauvecl`, with the flags that make it short."""
    words = shlex.split(command, comments=True)[1:]
    own = next((flags for begin, flags in INSTEAD.items() if shlex.join(words).startswith(begin)), None)
    return words + shlex.split(REDUCED.get(words[0], "") if own is None else own)


def not_run(command: str) -> bool:
    words = command.removeprefix("mauvecl ")
    return any(re.match(pattern, words) for pattern in NOT_RUN)


@pytest.mark.long
@pytest.mark.parametrize("page", [page for page in PAGES if any(snippets(page))], ids=lambda page: page.stem)
def test_snippets_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    for bring in BROUGHT.get(page.name, ()):
        bring()
    names: dict[str, object] = {}
    for kind, snippet in snippets(page):
        if kind == "command":
            if not not_run(snippet):
                run(*reduced(snippet), folder=tmp_path)
        else:
            read_snippet(kind, snippet, names)


def read_snippet(kind: str, snippet: str, names: dict[str, object]) -> None:
    """Write the file of a TOML block, or run a Python block in a namespace."""
    if kind == "toml":
        Path(snippet.partition("\n")[0].removeprefix("# ")).write_text(snippet)
    elif not any(word in snippet for word in NOT_EXECUTED):
        for many, few in FEWER.items():
            snippet = snippet.replace(many, few)
        exec(compile(snippet, "snippet", "exec"), names)


def test_skipped_snippets_exist_on_pages() -> None:
    """Check that every exception still belongs to a snippet."""
    every = [(page.name, kind, snippet) for page in PAGES for kind, snippet in snippets(page)]
    commands = [snippet.removeprefix("mauvecl ") for _, kind, snippet in every if kind == "command"]
    python = "".join(snippet for _, kind, snippet in every if kind == "python")
    assert len(commands) > 60
    for pattern in NOT_RUN:
        assert any(re.match(pattern, one) for one in commands), pattern
    for begin in (*REDUCED, *INSTEAD):
        assert any(one.startswith(begin) for one in commands), begin
    for word in (*FEWER, *NOT_EXECUTED):
        assert word in python, word
    assert set(BROUGHT) <= {name for name, *_ in every}
    ran = [one for one in commands if not not_run(f"mauvecl {one}")]
    assert len(ran) > 0.85 * len(commands)
