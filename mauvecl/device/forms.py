"""Which form of the kernels a scene, and what is asked of it, is launched with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mauvecl.device.launches import Launches
from mauvecl.device.opened import VECTORS, Device
from mauvecl.noise.scene import BATCH, Scene
from mauvecl.results.requests.channels import ChannelPlan
from mauvecl.results.requests.hypotheses import Hypotheses
from mauvecl.statistics.paper import Paper

#: Vectors of realisations that one work-item follows where it sums more than chi-squared: registers hold no more sums.
FEW_VECTORS = 2
#: Pixels drawn at once for resolution elements, which have some 35 and begin anywhere.
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
    """A scene on a device, with kernels of the form that it needs and no more room than they need."""
    variant = replace(
        device.variant,
        scenarios=BATCH[scene.frames],
        linears=_room_for(linears),
        frames=scene.frames,
        clip=scene.clip,
        pair=pair,
        noisy=scene.comparison.exposures > 0,
        estimated=scene.comparison.estimated,
        smooths=_room_for(smooths),
        slots=slots,
        elements=elements,
        joint=scene.joint,
        quartic=scene.quartic,
        photons=scene.photons,
        cosmic=scene.cosmic,
        modulations=scene.modulations,
        row_type=row_type,
        chunk=min(chunk or device.variant.chunk, device.variant.chunk),
    )
    alone = device.width == 1 or scene.frames or variant.compared
    many = VECTORS if not (variant.elements or variant.linears) else FEW_VECTORS
    return Launches(device, scene, replace(variant, vectors=1 if alone else many), seed)


def detection_launches(device: Device, scene: Scene, seed: int, plan: ChannelPlan, hypotheses: Hypotheses) -> Launches:
    """A scene on a device, with what every statistic of a detection needs."""
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


def _room_for(count: int) -> int:
    """Room in a kernel for so many statistics: a power of two, so that few programs are built."""
    return max(32, 1 << (count - 1).bit_length()) if count else 0
