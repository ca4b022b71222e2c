"""The probe kernels in every form that a device may be given."""

import pytest
from probes import Probes

from mauvecl import Engine


@pytest.fixture(scope="session", params=["vector forms", "vectors of built-ins", "scalar"])
def probes(request: pytest.FixtureRequest, engine: Engine) -> Probes:
    """Return probes of PoCL's fast forms, of the plain vectors for other compilers, and of a GPU's scalars."""
    width = 1 if request.param == "scalar" else 16
    return Probes(device=engine.open_device, width=width, vector_forms=request.param == "vector forms")
