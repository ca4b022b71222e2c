"""The same chi-squared by what an astronomer would write otherwise, each as well as it allows.

Every peer draws, for each realisation and pixel, Gaussian photon and read noise and a Poisson dark, rounds to whole DN,
and returns sum((raw - mean)^2 / variance). A peer that is not installed is left out.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from mauvecl import Expectation

Work = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Peer:
    """A program, its version, the realisations it needs for a steady rate, and its chi-squared."""

    name: str
    version: str
    realisations: int
    chi2: Work


@dataclass(frozen=True)
class Model:
    """Per pixel: Gaussian spread, what is no dark, dark, mean, weight."""

    sd: np.ndarray
    level: np.ndarray
    dark: np.ndarray
    mean: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, x: Expectation) -> Model:
        light = x.n_frames * x.gain_dn_per_electron**2 * (x.source_electrons + x.sky_electrons)
        sd = np.sqrt(light + x.n_frames * x.read_noise_dn**2 + (x.n_frames - 1) / 12)
        mean, dark = x.n_frames * x.mean_raw_dn, x.n_frames * x.dark_dn
        single = (a.astype(np.float32) for a in (sd, mean - dark))
        return cls(*single, dark, mean.astype(np.float32), (1 / x.variance_dn2).astype(np.float32))


def _blocks(n: int, size: int = 64) -> list[tuple[int, int]]:
    return [(start, min(size, n - start)) for start in range(0, n, size)]


def numpy_peer(m: Model) -> Peer:
    """Return the peer of NumPy's Generator: one thread, float32 normals, blocks that stay in the cache."""
    generator = np.random.default_rng(1)

    def chi2(n: int) -> np.ndarray:
        return np.concatenate([_numpy_block(m, generator, size) for _, size in _blocks(n)])

    return Peer("NumPy Generator, one thread", np.__version__, 2_000, chi2)


def numpy_threads_peer(m: Model) -> Peer:
    """Draw on two threads, each with its own Generator, which releases the interpreter's lock."""
    generators = [np.random.default_rng(seed) for seed in (1, 2)]

    def part(index: int, n: int) -> np.ndarray:
        return np.concatenate([_numpy_block(m, generators[index], size) for _, size in _blocks(n)])

    def chi2(n: int) -> np.ndarray:
        with ThreadPoolExecutor(2) as pool:
            return np.concatenate(list(pool.map(part, (0, 1), (n // 2, n - n // 2))))

    return Peer("NumPy Generator, two threads", np.__version__, 4_000, chi2)


def _numpy_block(m: Model, generator: np.random.Generator, n: int) -> np.ndarray:
    raw = generator.standard_normal((n, m.mean.size), dtype=np.float32) * m.sd + m.level
    raw += generator.poisson(m.dark, (n, m.mean.size))
    np.rint(raw, out=raw)
    raw -= m.mean
    raw *= raw
    return raw @ m.weight


def numba_peer(m: Model) -> Peer:
    """Return the peer of Numba: prange over realisations, Numba's generators."""
    import numba

    @numba.njit(parallel=True, fastmath=True)
    def loop(out, sd, level, dark, mean, weight):  # type: ignore[no-untyped-def]
        for r in numba.prange(out.size):
            total = np.float32(0.0)
            for p in range(mean.size):
                normal, count = np.random.standard_normal(), np.random.poisson(dark[p])  # noqa: NPY002
                raw = np.rint(normal * sd[p] + level[p] + count)
                x = np.float32(raw) - mean[p]
                total += x * x * weight[p]
            out[r] = total

    def chi2(n: int) -> np.ndarray:
        out = np.empty(n, np.float32)
        loop(out, m.sd, m.level, m.dark, m.mean, m.weight)
        return out

    return Peer("Numba prange", numba.__version__, 4_000, chi2)


def jax_peer(m: Model) -> Peer:
    """Return the peer of JAX on the CPU: compiled, in blocks."""
    import jax
    import jax.numpy as jnp

    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu):
        sd, level, dark, mean, weight = (jnp.asarray(a, jnp.float32) for a in (m.sd, m.level, m.dark, m.mean, m.weight))

        @jax.jit
        def block(key):  # type: ignore[no-untyped-def]
            one, other = jax.random.split(key)
            raw = jax.random.normal(one, (64, mean.size)) * sd + level
            raw = jnp.rint(raw + jax.random.poisson(other, dark, (64, mean.size)))
            return (raw - mean) ** 2 @ weight

        def chi2(n: int) -> np.ndarray:
            keys = jax.random.split(jax.random.key(1), len(_blocks(n)))
            return np.concatenate([np.asarray(block(key)) for key in keys])[:n]

    return Peer("JAX, CPU", jax.__version__, 1_024, chi2)


def mkl_peer(m: Model) -> Peer:
    """Return the peer of Intel MKL through mkl_random, whose Poisson of a large mean is a rounded normal."""
    import mkl_random

    generator = mkl_random.MKLRandomState(1, brng="PHILOX4X32X10")

    def chi2(n: int) -> np.ndarray:
        out = []
        for _, size in _blocks(n):
            raw = generator.standard_normal((size, m.mean.size)) * m.sd + m.level
            raw += generator.poisson(m.dark, (size, m.mean.size))
            np.rint(raw, out=raw)
            raw -= m.mean
            raw *= raw
            out.append(raw @ m.weight)
        return np.concatenate(out)

    return Peer("Intel MKL through mkl_random", importlib.metadata.version("mkl_random"), 2_000, chi2)


MAKERS = (numpy_peer, numpy_threads_peer, numba_peer, jax_peer, mkl_peer)


class Child:
    """A peer in a process of its own: no thread pool of one program waits busily while another is measured."""

    def __init__(self, make: Callable[[Model], Peer], model: Model) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, make, model), daemon=True)
        self._process.start()
        # The pipe ends with the child only if nobody else holds its end.
        theirs.close()
        self.name = make.__name__
        found = self._received()
        if isinstance(found, str):
            raise ImportError(found)
        self.name, self.realisations, mean = found
        pixels = model.mean.size
        if abs(mean - pixels) > 6 * np.sqrt(2 * pixels / 1024):
            print(f"CAUTION: {self.name} has a mean chi2 of {mean:.1f} for {pixels} pixels")

    def _received(self) -> Any:
        """Return what the child sends; raises ChildProcessError if it has ended."""
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError) as error:
            self._process.join()
            raise ChildProcessError(f"{self.name} ended with exit code {self._process.exitcode}") from error

    def seconds(self) -> float:
        """Return the time of one run, s; raises ChildProcessError if the child has ended."""
        with contextlib.suppress(ConnectionError):
            self._pipe.send(True)
        return float(self._received())

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(ConnectionError):
            self._pipe.send(False)
        self._process.join()


def _serve(pipe: Connection, make: Callable[[Model], Peer], model: Model) -> None:
    try:
        peer = make(model)
    except ImportError as error:
        pipe.send(str(error))
        return
    pipe.send((f"{peer.name} {peer.version}", peer.realisations, float(peer.chi2(1024).mean())))
    while pipe.recv():
        start = time.perf_counter()
        peer.chi2(peer.realisations)
        pipe.send(time.perf_counter() - start)


def children(x: Expectation) -> list[Child]:
    """Return the installed peers, compiled and with checked mean chi-squared."""
    found = []
    for make in MAKERS:
        try:
            found.append(Child(make, Model.of(x)))
        except (ImportError, ChildProcessError) as error:
            print(f"left out: {error}")
    return found
