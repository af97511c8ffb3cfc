"""Exact propagators of a continuous plant over one sampling interval, for every kind of signal.

The plant is dx/dt = A x + G d(t), G = [B, E], and the drive d is split into three parts, each integrated exactly:
sinusoids (they join the state as oscillators), values held over a tick (constants, and ``normal``, which is drawn once
per tick), and switches of ``step`` and ``square`` inside a tick (superposed, see ``_switches``).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array, contiguous
from duio_mesh.dynamics import SINUSOIDS, signal
from duio_mesh.errors import DesignError
from duio_mesh.scenario.model import Signal

_MOST_PULSES = 20_000  # switches inside ticks in one run; more means a square wave far faster than the sampling
_NO_DRAW = np.random.default_rng(0)  # steps and squares draw nothing; the evaluator's signature asks for a stream


def propagators(A: Array, G: Array, drives: Sequence[Signal], step: float, steps: int) -> dict[str, Array]:
    """The matrices of x(k+1) = Phi x + Psi s(k) + Gamma held(k) + switched(k), d(k) = H s(k) + held(k).

    A (n, n), G (n, c), one signal per column of G; ``step`` in seconds. Returns

    - ``periods`` (f,), seconds: s(t) stacks sin(2 pi t / period) and then cos(2 pi t / period), (2f,),
    - ``H`` (c, 2f): the drives' sinusoidal part as a mixture of s,
    - ``Phi`` (n, n), ``Psi`` (n, 2f), ``Gamma`` (n, c),
    - ``switch_ticks`` (S,) and ``switch_effects`` (S, n): the ticks inside which some drive switches, and what that
      adds to x at the end of the tick beyond holding the value from its beginning.

    Raises DesignError when the drives switch inside ticks more than 20 000 times in the run.
    """
    n, c = G.shape
    periods = sorted(
        {p["period"] for terms in drives for term in terms for kind, p in term.items() if kind in SINUSOIDS}
    )
    f = len(periods)
    omega = 2 * np.pi / np.array(periods)
    oscillator = np.block([[np.zeros((f, f)), np.diag(omega)], [-np.diag(omega), np.zeros((f, f))]])
    H = _mixture(drives, periods)
    generator = np.zeros((n + 2 * f + c, n + 2 * f + c))
    generator[:n] = np.hstack([A, G @ H, G])
    generator[n : n + 2 * f, n : n + 2 * f] = oscillator
    flow = linalg.expm(generator * step)[:n]
    ticks, effects = _switches(A, G, drives, step, steps)
    return {
        "periods": contiguous(periods),
        "H": contiguous(H),
        "Phi": contiguous(flow[:, :n]),
        "Psi": contiguous(flow[:, n : n + 2 * f]),
        "Gamma": contiguous(flow[:, n + 2 * f :]),
        "switch_ticks": ticks,
        "switch_effects": effects,
    }


def _mixture(drives: Sequence[Signal], periods: Sequence[float]) -> Array:
    """H (c, 2f): amplitude sin(wt + phase) = amplitude (cos(phase) sin wt + sin(phase) cos wt)."""
    f = len(periods)
    H = np.zeros((len(drives), 2 * f))
    for row, terms in zip(H, drives, strict=True):
        for term in terms:
            for kind, p in term.items():
                if kind in SINUSOIDS:
                    phase = p["phase"] + (math.pi / 2 if kind == "cosine" else 0.0)
                    at = periods.index(p["period"])
                    row[at] += p["amplitude"] * math.cos(phase)
                    row[f + at] += p["amplitude"] * math.sin(phase)
    return H


def _switches(A: Array, G: Array, drives: Sequence[Signal], step: float, steps: int) -> tuple[Array, Array]:
    """What steps and squares add inside the ticks in which they switch: ticks (S,) and effects (S, n).

    A tick is cut at its switching times; on each piece the drive is what it is in the middle of the piece, so rounding
    of a switching time against the sampling grid cannot put a tick on the wrong side.
    """
    effects: dict[int, Array] = defaultdict(lambda: np.zeros(A.shape[0]))
    pulses = 0
    for g, terms in zip(G.T, drives, strict=True):
        for term in terms:
            for kind, p in term.items():
                for k, start, end, jump in _pieces(kind, p, step, steps):
                    pulses += 1
                    if pulses > _MOST_PULSES:
                        raise DesignError(
                            f"a {kind} signal of the plant switches inside a tick more than {_MOST_PULSES} times in "
                            f"the run ({dict(p)}, sampled every {step:g} s): make it slower or align it with the ticks"
                        )
                    t_end = (k + 1) * step
                    effects[k] += (_held(A, g, t_end - start) - _held(A, g, t_end - end)) * jump
    ticks = sorted(effects)
    return contiguous(ticks), contiguous([effects[k] for k in ticks]).reshape(len(ticks), A.shape[0])


def _pieces(kind: str, p: Mapping[str, float], step: float, steps: int) -> Iterator[tuple[int, float, float, float]]:
    """(tick, start, end, jump) of every piece of a tick where the term differs from its value at the tick's start."""
    times = _switching_times(kind, p, step * steps)
    on_grid = 1e-6  # of a tick: a switch this close to a sample may have been rounded to either side of it
    touched = np.unique(np.floor(np.concatenate([times / step - on_grid, times / step + on_grid])))
    for k in touched[(touched >= 0) & (touched < steps)].astype(int):
        t, t_end = k * step, (k + 1) * step
        inside = times[np.searchsorted(times, t, "right") : np.searchsorted(times, t_end)]
        at_start = signal([{kind: p}], t, _NO_DRAW)
        for start, end in pairwise([t, *inside, t_end]):
            jump = signal([{kind: p}], (start + end) / 2, _NO_DRAW) - at_start
            if jump:
                yield int(k), start, end, jump


def _switching_times(kind: str, p: Mapping[str, float], horizon: float) -> Array:
    """Ascending times (s), about [0, horizon], at which the term changes its value; () when it never does."""
    if kind == "step":
        return contiguous([p["time"]])
    if kind == "square":  # the sign changes of sin(2 pi t / period + phase)
        half, offset = p["period"] / 2, p["phase"] / math.pi
        return np.asarray((np.arange(math.floor(offset), math.ceil(offset + horizon / half) + 1.0) - offset) * half)
    return np.zeros(0)


def _held(A: Array, g: Array, duration: float) -> Array:
    """x (n,) after a unit drive through g (n,) for ``duration`` seconds from rest."""
    n = A.shape[0]
    generator = np.zeros((n + 1, n + 1))
    generator[:n, :n], generator[:n, n] = A, g
    return np.asarray(linalg.expm(generator * duration)[:n, n])
