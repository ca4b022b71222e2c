"""Write the list of stars that are known by name, `host/orbit/targets.ecsv`.

python tools/build_targets.py HIP2.DAT

HIP2.DAT is the main table of the new reduction of the Hipparcos data (van Leeuwen 2007, CDS catalogue I/311); places
and distances are from there. V and spectral types are rounded values of the literature, and each place is compared with
the constellation that the name has, each V with the catalogue's Hp.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord, get_constellation
from astropy.table import Table
from astropy.utils import iers

PLACE = Path(__file__).parent.parent / "host" / "orbit" / "targets.ecsv"
#: Right ascension and declination (rad), parallax (mas), proper motions (mas/yr), Hp.
COLUMNS = ((15, 28), (29, 42), (43, 50), (51, 59), (60, 68), (129, 136))
#: Name, HIP, V, spectral type, constellation, other names.
STARS = """
eps Eri       | 16537  | 3.73 | K2V    | Eri | HD 22049, GJ 144, Ran
AU Mic        | 102409 | 8.63 | M1V    | Mic | HD 197481, GJ 803
EV Lac        | 112460 | 10.1 | M4V    | Lac | GJ 873
YZ CMi        | 37766  | 11.1 | M4V    | CMi | GJ 285
Proxima Cen   | 70890  | 11.1 | M5V    | Cen | GJ 551, Proxima
alpha Cen A   | 71683  | 0.0  | G2V    | Cen | HD 128620, Rigil Kentaurus
alpha Cen B   | 71681  | 1.33 | K1V    | Cen | HD 128621
kappa1 Cet    | 15457  | 4.84 | G5V    | Cet | HD 20630
pi1 UMa       | 42438  | 5.63 | G1V    | UMa | HD 72905
EK Dra        | 71631  | 7.6  | G1V    | Dra | HD 129333
V889 Her      | 91043  | 7.4  | G2V    | Her | HD 171488
AB Dor        | 25647  | 6.9  | K0V    | Dor | HD 36705
HD 189733     | 98505  | 7.65 | K1V    | Vul | V452 Vul
BY Dra        | 91009  | 8.1  | K6V    | Dra | HD 234677, GJ 719
61 Cyg A      | 104214 | 5.21 | K5V    | Cyg | HD 201091, GJ 820 A
61 Cyg B      | 104217 | 6.05 | K7V    | Cyg | HD 201092, GJ 820 B
Lalande 21185 | 54035  | 7.52 | M2V    | UMa | HD 95735, GJ 411
GX And        | 1475   | 8.1  | M2V    | And | GJ 15 A, HD 1326
Sirius        | 32349  | -1.46| A1V    | CMa | alpha CMa, HD 48915
Vega          | 91262  | 0.03 | A0V    | Lyr | alpha Lyr, HD 172167
Altair        | 97649  | 0.76 | A7V    | Aql | alpha Aql, HD 187642
Procyon       | 37279  | 0.37 | F5V    | CMi | alpha CMi, HD 61421
tau Cet       | 8102   | 3.49 | G8V    | Cet | HD 10700, GJ 71
18 Sco        | 79672  | 5.5  | G2V    | Sco | HD 146233
51 Peg        | 113357 | 5.46 | G2V    | Peg | HD 217014
HD 209458     | 108859 | 7.65 | F9V    | Peg | V376 Peg
xi Boo A      | 72659  | 4.7  | G8V    | Boo | HD 131156, GJ 566 A
70 Oph        | 88601  | 4.03 | K0V    | Oph | HD 165341, GJ 702
V711 Tau      | 16846  | 5.8  | K1IV   | Tau | HR 1099, HD 22468
II Peg        | 117915 | 7.4  | K2IV   | Peg | HD 224085
LQ Hya        | 46816  | 7.8  | K1V    | Hya | HD 82558, GJ 355
DX Leo        | 46843  | 7.05 | G9V    | Leo | HD 82443, GJ 354.1
GJ 1          | 439    | 8.55 | M2V    | Scl | HD 225213
Lacaille 9352 | 114046 | 7.34 | M1V    | PsA | GJ 887, HD 217987
GJ 832        | 106440 | 8.67 | M2V    | Gru | HD 204961
AX Mic        | 105090 | 6.67 | M0V    | Mic | GJ 825, HD 202560, Lacaille 8760
GJ 436        | 57087  | 10.6 | M3V    | Leo |
Fomalhaut     | 113368 | 1.16 | A3V    | PsA | alpha PsA, HD 216956
beta Pic      | 27321  | 3.86 | A6V    | Pic | HD 39060
HD 40307      | 27887  | 7.15 | K2.5V  | Pic |
zeta Tau      | 26451  | 3.03 | B2IV   | Tau | HD 37202
AT Mic        | 102141 | 10.3 | M4V    | Mic | GJ 799, HD 196982
Barnard       | 87937  | 9.51 | M4V    | Oph | GJ 699, Barnard's star
Kapteyn       | 24186  | 8.85 | M1V    | Pic | GJ 191, HD 33793
GJ 581        | 74995  | 10.6 | M3V    | Lib |
GJ 205        | 25878  | 7.97 | M1V    | Ori | HD 36395
Wolf 1061     | 80824  | 10.1 | M3V    | Oph | GJ 628
GJ 229        | 29295  | 8.13 | M1V    | Lep | HD 42581
GJ 338 A      | 45343  | 7.64 | M0V    | UMa | HD 79210
GJ 338 B      | 120005 | 7.74 | M0V    | UMa | HD 79211
GJ 176        | 21932  | 9.95 | M2V    | Tau | HD 285968
V1216 Sgr     | 92403  | 10.4 | M3V    | Sgr | GJ 729, Ross 154
Ross 128      | 57548  | 11.1 | M4V    | Vir | GJ 447, FI Vir
Luyten        | 36208  | 9.87 | M3V    | CMi | GJ 273, Luyten's star
GJ 908        | 117473 | 8.98 | M1V    | Psc | BR Psc
GJ 526        | 67155  | 8.46 | M2V    | Boo | HD 119850
GJ 880        | 113296 | 8.64 | M1V    | Peg | HD 216899
V1428 Aql     | 94761  | 9.12 | M3V    | Aql | GJ 752 A, HD 180617
Denebola      | 57632  | 2.14 | A3V    | Leo | beta Leo, HD 102647
sigma Dra     | 96100  | 4.68 | K0V    | Dra | HD 185144
40 Eri A      | 19849  | 4.43 | K1V    | Eri | omicron2 Eri, HD 26965
107 Psc       | 7981   | 5.24 | K1V    | Psc | HD 10476
HD 219134     | 114622 | 5.57 | K3V    | Cas | GJ 892
gamma Lep     | 27072  | 3.6  | F6V    | Lep | HD 38393
iota Hor      | 12653  | 5.4  | F8V    | Hor | HD 17051
chi1 Ori      | 27913  | 4.41 | G0V    | Ori | HD 39587
EP Eri        | 13402  | 6.05 | K1V    | Eri | HD 17925
BE Cet        | 1803   | 6.39 | G2V    | Cet | HD 1835
HN Peg        | 107350 | 5.96 | G0V    | Peg | HD 206860
BO Mic        | 102626 | 9.4  | K3V    | Mic | HD 197890, Speedy Mic
pi Men        | 26394  | 5.65 | G0V    | Men | HD 39091
55 Cnc        | 43587  | 5.95 | G8V    | Cnc | HD 75732
HD 97658      | 54906  | 7.71 | K1V    | Leo |
WASP-33       | 11397  | 8.3  | A5V    | And | HD 15082
"""


def main() -> None:
    """Read the catalogue, look each star up, compare, write."""
    iers.conf.auto_download = False
    wanted = [[part.strip() for part in line.split("|")] for line in STARS.strip().splitlines()]
    numbers = {int(row[1]) for row in wanted}
    found: dict[int, list[float]] = {}
    with Path(sys.argv[1]).open(encoding="ascii") as file:
        for line in file:
            if int(line[:6]) in numbers:
                found[int(line[:6])] = [float(line[a:b]) for a, b in COLUMNS]
    rows = []
    for name, hip, v, kind, constellation, others in wanted:
        ra, dec, parallax, motion_ra, motion_dec, hp = found[int(hip)]
        # From the catalogue's epoch, 1991.25, to 2000; mas to rad.
        years = 8.75 / 206_264_806.0
        right, north = np.degrees(ra + motion_ra * years / np.cos(dec)), np.degrees(dec + motion_dec * years)
        here = get_constellation(SkyCoord(right, north, unit="deg"), short_name=True)
        if here != constellation or abs(hp - float(v)) > 0.45:
            sys.stderr.write(f"{name}: HIP {hip} lies in {here} with Hp = {hp}\n")
        others = ", ".join([f"HIP {hip}", *filter(None, [others])])
        rows.append((name, round(right, 5), round(north, 5), round(1000 / parallax, 3), float(v), kind, others))
    table = Table(rows=rows, names=("name", "ra", "dec", "distance", "V", "spectral_type", "other_names"))
    for column, unit in (("ra", "deg"), ("dec", "deg"), ("distance", "pc"), ("V", "mag")):
        table[column].info.unit = unit
    table.meta = {
        "description": "Stars known by name: ICRS at epoch 2000, distance, V, spectral type",
        "source": "places and distances: Hipparcos, new reduction (van Leeuwen 2007, A&A 474, 653; CDS I/311); V and "
        "spectral type: the literature, rounded, of binaries together where not resolved",
    }
    table.write(PLACE, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
