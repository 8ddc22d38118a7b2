"""Columns of a record for Triton kernels, equal to `nerfloom.kernels.splats.project.Record`."""

import triton.language as tl

from nerfloom.kernels.splats import project

X, Y, U_X, U_Y, V_Y, OPACITY, CUT, REACH_X, RED, GREEN, BLUE, DISTANCE, NORMAL_X, NORMAL_Y, NORMAL_Z, REACH_Y = (
    tl.constexpr(int(column)) for column in project.Record
)
RECORD = tl.constexpr(project.RECORD)
"""Number of columns."""
