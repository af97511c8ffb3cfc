"""Zenoh: sessions, key expressions, frames, the start barrier and waiting. The only place that imports zenoh.

It knows frames and names, not observers: floats go in and come out with a step and a round.
"""

from __future__ import annotations

from duio_mesh.mesh.frames import Decoder, Encoder, Frame, Rejected
from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.outside import Heard, OutsideWorld
from duio_mesh.mesh.session import Member, Mesh, Outlet, Source

__all__ = [
    "Decoder",
    "Encoder",
    "Frame",
    "Heard",
    "Keys",
    "Member",
    "Mesh",
    "Outlet",
    "OutsideWorld",
    "Rejected",
    "Source",
]
