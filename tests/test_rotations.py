"""Rotations compared with SciPy, and independence of the rows of a batch."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rover_rl.rotations import level_to_euler, matrix_to_quaternion, quaternion_to_euler, wrap_angle


def random_quaternions(count: int) -> torch.Tensor:
    q = torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def test_euler_angles_use_static_xyz_axes():
    q = random_quaternions(500)
    expected = torch.from_numpy(Rotation.from_quat(q.numpy()).as_euler("xyz"))
    torch.testing.assert_close(quaternion_to_euler(q), expected, atol=1e-6, rtol=0)


def test_level_quaternions_have_the_same_euler_angles_to_the_last_bit():
    half = torch.linspace(-4, 4, 1001)[:, None]
    q = torch.cat((torch.zeros(1001, 2), half.sin(), half.cos()), -1)
    assert torch.equal(level_to_euler(q), quaternion_to_euler(q))


def test_matrix_to_quaternion_inverts_scipys_matrix():
    q = random_quaternions(500)
    q = torch.where(q[:, 3:] < 0, -q, q)
    matrix = torch.from_numpy(Rotation.from_quat(q.numpy()).as_matrix())
    torch.testing.assert_close(matrix_to_quaternion(matrix), q, atol=1e-9, rtol=0)


@pytest.mark.parametrize("axis", range(3))
def test_matrix_to_quaternion_at_half_turns(axis):
    turn = torch.zeros(4, dtype=torch.float64)
    turn[axis] = 1.0
    matrix = torch.from_numpy(Rotation.from_quat(turn.numpy()).as_matrix())[None]
    torch.testing.assert_close(matrix_to_quaternion(matrix)[0].abs(), turn, atol=1e-9, rtol=0)


@given(st.floats(-50, 50))
def test_wrap_angle_is_atan2_of_sine_and_cosine(angle):
    wrapped = wrap_angle(torch.tensor(angle, dtype=torch.float64)).item()
    assert -math.pi <= wrapped <= math.pi
    difference = wrapped - math.atan2(math.sin(angle), math.cos(angle))
    assert min(abs(difference), abs(abs(difference) - 2 * math.pi)) < 1e-9
