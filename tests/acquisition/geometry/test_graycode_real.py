# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a real projector and camera: ../shared/data/graycode-real.

42 photographs, 1280 x 1024, of Gray code for 1024 x 768 in OpenCV's order, and the authors'
calibration. The authors count a step of the code as two projector pixels.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, decode

pytestmark = pytest.mark.slow

GRID = (768, 1024)
STEP = 2.0  # the authors' projector pixels in a step of the code


@pytest.fixture(scope="module")
def photographs(shared_data: Path) -> list[np.ndarray]:
    paths = sorted((shared_data / "graycode-real").glob("graycode_*.png"))
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]


@pytest.fixture(scope="module")
def mapping(photographs) -> Correspondence:
    return decode(photographs, GRID)


@pytest.fixture(scope="module")
def board(photographs) -> np.ndarray:
    """Pixels inside the corners of the chessboard."""
    seen, corners = cv2.findChessboardCorners(photographs[40], (7, 9))
    assert seen
    hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(photographs[0].shape, np.uint8), hull, 1) > 0


def test_lit_pixels_are_decoded_and_others_are_not(photographs, mapping, board):
    lit = photographs[40].astype(float) - photographs[41]
    assert mapping.valid[lit > 30].mean() > 0.9  # translucent tape washes out the finest stripes
    assert mapping.valid[board & (lit > 60)].mean() > 0.999  # the white squares
    assert mapping.valid[lit < 5].mean() < 0.03


@pytest.fixture(scope="module")
def points(mapping, board) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) of the board's pixels in the camera, and of what they see in the projector."""
    valid = board & mapping.valid
    projector = np.stack([mapping.x[valid], mapping.y[valid]], axis=1)
    return np.argwhere(valid)[:, ::-1].astype(np.float64), projector


def test_the_board_is_a_plane(points):
    """Except for lens distortion, a homography takes one picture of a plane to the other."""
    camera, projector = points
    H, _ = cv2.findHomography(camera, projector, cv2.RANSAC, 1.0)
    distance = np.linalg.norm(
        cv2.perspectiveTransform(camera[:, None], H)[:, 0] - projector, axis=1
    )
    assert np.median(distance) < 0.15
    assert np.sqrt(np.mean(distance**2)) < 0.25
    assert np.mean(distance > 1.0) < 0.001


@pytest.mark.slow
def test_the_calibration_of_the_authors_agrees(shared_data, points):
    """Triangulated points project back on their pixels, within its own residual of 0.86."""
    path = shared_data / "graycode-real" / "calibration_result.xml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K = file.getNode("cam_int").mat()
    D = file.getNode("cam_dist").mat()
    P = file.getNode("proj_int").mat()
    E = file.getNode("proj_dist").mat()
    R = file.getNode("roration").mat()
    t = file.getNode("translation").mat()
    camera = points[0][::20]
    projector = STEP * points[1][::20].astype(np.float64)
    lenses = ((camera, K, D), (projector, P, E))
    rays = [cv2.undistortPoints(points[:, None], k, d)[:, 0].T for points, k, d in lenses]
    X = cv2.triangulatePoints(np.eye(3, 4), np.hstack([R, t.reshape(3, 1)]), *rays)
    X = (X[:3] / X[3]).T
    rotation, _ = cv2.Rodrigues(R)
    in_projector, _ = cv2.projectPoints(X, rotation, t, P, E)
    in_camera, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, D)
    for seen, exact in ((in_projector[:, 0], projector), (in_camera[:, 0], camera)):
        assert np.sqrt(np.mean(np.sum((seen - exact) ** 2, axis=1))) < 0.857
    flat = X - X.mean(axis=0)
    spread = np.linalg.svd(flat, full_matrices=False)[1] / np.sqrt(len(X))
    assert spread[2] < 0.02 * spread[1]  # the board is flat
