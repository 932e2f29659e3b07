"""What one camera sees, and memory for it that is used again when nobody holds the picture any more.

The operating system hands out fresh memory of that size page by page, which costs as much as drawing ground and sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SMALL = 1 << 17
"""Pieces of fewer bytes are asked for anew: the C library keeps such memory itself."""

SPARES = 8
"""Most pieces of memory that wait for use: two cameras' pictures of this step and of the last one, twice."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What one camera sees.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, m along the optical axis; inf where there is only sky.
        instances: (H, W) int32, index of the object in the snapshot; -1 for scenery, ground and sky.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instances: NDArray[np.int32]

    @classmethod
    def empty(cls, width: int, height: int) -> Frame:
        """Arrays to render into, contents undefined."""
        return cls(
            np.empty((height, width, 3), np.uint8),
            np.empty((height, width), np.float32),
            np.empty((height, width), np.int32),
        )

    def copy(self) -> Frame:
        """A frame that shares no memory with this one."""
        return Frame(self.rgb.copy(), self.depth.copy(), self.instances.copy())


class Memory:
    """Lends pieces of `nbytes` bytes. A piece comes back when the last array that looks into it is gone."""

    def __init__(self, nbytes: int) -> None:
        self.nbytes = nbytes
        self._spare: list[NDArray[np.uint8]] = []

    def take(self) -> NDArray[np.uint8]:
        """Bytes (nbytes,), contents undefined; nobody else's while this array or a view of it lives."""
        if self.nbytes < SMALL:
            return np.empty(self.nbytes, np.uint8)
        piece = self._spare.pop() if self._spare else np.empty(self.nbytes, np.uint8)
        return np.asarray(_Loan(piece, self._spare))


class FrameMemory(Memory):
    """Lends frames of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        super().__init__(11 * width * height)

    def frame(self) -> Frame:
        """Arrays to render into, contents undefined."""
        if 4 * self.width * self.height < SMALL:
            return Frame.empty(self.width, self.height)
        flat, pixels, shape = self.take(), self.width * self.height, (self.height, self.width)
        return Frame(
            flat[8 * pixels :].reshape(*shape, 3),
            flat[: 4 * pixels].view(np.float32).reshape(shape),
            flat[4 * pixels : 8 * pixels].view(np.int32).reshape(shape),
        )


class _Loan:
    """The base of the arrays that look into a piece: NumPy lets go of it with the last of them."""

    def __init__(self, piece: NDArray[np.uint8], spare: list[NDArray[np.uint8]]) -> None:
        self.__array_interface__: dict[str, Any] = piece.__array_interface__
        self._piece, self._spare = piece, spare

    def __del__(self) -> None:
        if len(self._spare) < SPARES:
            self._spare.append(self._piece)
