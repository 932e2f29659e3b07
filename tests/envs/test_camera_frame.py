"""Memory of pictures: used again when nobody holds them, and never before."""

from __future__ import annotations

import pickle

import numpy as np

from covis.envs.camera.frame import SMALL, FrameMemory, Memory

WIDTH, HEIGHT = 320, 240


def test_a_frame_has_its_shapes_and_types_and_no_part_overlaps_another() -> None:
    frame = FrameMemory(WIDTH, HEIGHT).frame()
    frame.rgb[:], frame.depth[:], frame.instances[:] = 1, 2.0, 3
    assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
    assert (frame.rgb == 1).all()
    assert frame.depth.shape == (HEIGHT, WIDTH)
    assert frame.depth.dtype == np.float32
    assert (frame.depth == 2).all()
    assert frame.instances.dtype == np.int32
    assert (frame.instances == 3).all()
    assert all(a.flags.c_contiguous and a.flags.writeable for a in vars(frame).values())


def test_memory_is_used_again_once_its_frame_is_gone() -> None:
    memory = FrameMemory(WIDTH, HEIGHT)
    frame = memory.frame()
    place = frame.depth.ctypes.data
    del frame
    assert memory.frame().depth.ctypes.data == place


def test_memory_is_never_used_again_while_any_view_of_it_lives() -> None:
    memory = FrameMemory(WIDTH, HEIGHT)
    frame = memory.frame()
    frame.rgb[:] = 7
    corner = frame.rgb[:2, :2, 1]
    del frame
    others = [memory.frame() for _ in range(3)]
    for other in others:
        other.rgb[:] = 9
    assert (corner == 7).all()


def test_a_pickled_frame_is_a_copy_of_its_own() -> None:
    frame = FrameMemory(WIDTH, HEIGHT).frame()
    frame.depth[:] = 4.0
    back = pickle.loads(pickle.dumps(frame))
    frame.depth[:] = 5.0
    assert (back.depth == 4).all()


def test_little_memory_is_the_c_librarys() -> None:
    memory = Memory(SMALL - 1)
    assert memory.take().flags.owndata


def test_memory_outlives_what_lent_it() -> None:
    memory = Memory(SMALL)
    piece = memory.take()
    piece[:] = 3
    del memory
    assert (piece == 3).all()
