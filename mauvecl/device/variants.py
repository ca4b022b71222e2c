"""Choice of the kernel variant for a scene and its statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mauvecl.detection.chi2 import Paper
from mauvecl.detection.requests import ChannelPlan, Hypotheses
from mauvecl.device.device import VECTORS, Device
from mauvecl.device.launches import Launches
from mauvecl.noise.scene import BATCH, Scene

#: Vectors of realisations per work-item with sums other than chi-squared, limited by the number of registers.
FEW_VECTORS = 2
#: Pixels drawn at once for resolution elements, which have about 35 pixels and start at any pixel.
ELEMENT_CHUNK = 8


def scene_launches(
    device: Device,
    scene: Scene,
    seed: int,
    *,
    pair: bool = False,
    elements: bool = True,
    linears: int = 0,
    smooths: int = 0,
    slots: int = 0,
    row_type: str = "int",
    chunk: int | None = None,
) -> Launches:
    """Return the launches of a scene, with the smallest kernel variant that suits it."""
    variant = replace(
        device.variant,
        scenarios=BATCH[scene.frames],
        linears=_capacity(linears),
        frames=scene.frames,
        clip=scene.clip,
        pair=pair,
        noisy=scene.comparison.exposures > 0,
        estimated=scene.comparison.estimated,
        smooths=_capacity(smooths),
        slots=slots,
        elements=elements,
        joint=scene.joint,
        quartic=scene.quartic,
        photons=scene.photons,
        additive=scene.additive,
        modulations=scene.modulations,
        row_type=row_type,
        chunk=min(chunk or device.variant.chunk, device.variant.chunk),
    )
    single = device.width == 1 or scene.frames or variant.compared
    many = VECTORS if not (variant.elements or variant.linears) else FEW_VECTORS
    return Launches(device, scene, replace(variant, vectors=1 if single else many), seed)


def detection_launches(device: Device, scene: Scene, seed: int, plan: ChannelPlan, hypotheses: Hypotheses) -> Launches:
    """Return the launches of a scene, with the weights and scales of all statistics of a detection."""
    bands, finished = np.zeros((1, 0, 1), np.float32), np.zeros(1, np.uint32)
    if len(plan.scales):
        bands, finished = Paper().smoothing(hypotheses.setting).bands(len(scene.pixels), device.variant.chunk)
    sums = {hypotheses.statistic(name).kernel_sum for name in hypotheses.statistics}
    launches = scene_launches(
        device,
        scene,
        seed,
        pair="chi2_pair" in sums,
        elements="chi2_element" in sums,
        linears=len(plan.weights),
        smooths=len(plan.scales),
        slots=bands.shape[1],
    )
    launches.weigh(plan.weights, plan.linear_end, plan.pixels_end)
    if plan.subtractions.size:
        launches.marginalise(plan.subtractions)
    if launches.variant.compared:
        launches.compare(bands, finished, plan.scales, plan.scale_end)
    return launches


def _capacity(count: int) -> int:
    """Round a number of statistics up to a power of two, so that few programs are built."""
    return max(32, 1 << (count - 1).bit_length()) if count else 0
