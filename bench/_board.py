# SPDX-License-Identifier: BSD-3-Clause
"""A chessboard before a real projector and camera, from photographs that lie beside the checkout.

42 photographs, 1280 x 1024, of Gray code for 1024 x 768, and the calibration that their authors found. They
count a step of the code as two projector pixels.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ltcl.acquisition.geometry import Correspondence, decode

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "graycode-real"
GRID, STEP = (768, 1024), 2.0
LIT = 30  # codes that white shows more than black


def facts(folder: Path = FOLDER) -> dict[str, float | str]:
    """What is decoded, how flat the board is, and whether the authors' calibration agrees."""
    if not folder.is_dir():
        return {"real photographs": f"left out, {folder.name} is not beside the checkout"}
    paths = sorted(folder.glob("graycode_*.png"))
    photographs = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    found = decode(photographs, GRID)
    lit = photographs[-2].astype(np.float32) - photographs[-1] > LIT
    board = found.valid & _board(photographs[-2])
    distance = _from_homography(found, board)
    back, ahead = _reprojected(found, board, folder)
    return {
        "real photographs, lit pixels decoded": float(found.valid[lit].mean()),
        "real, from a homography on the board, median of projector pixels": float(np.median(distance)),
        "real, from a homography on the board, rms": float(np.sqrt(np.mean(distance**2))),
        "real, reprojected by the authors' calibration, rms of projector pixels": back,
        "real, and of camera pixels (its own residual is 0.86)": ahead,
    }


def _from_homography(found: Correspondence, board: np.ndarray) -> np.ndarray:
    """Projector pixels between each pixel of the board and the homography that fits them best."""
    camera = np.stack(np.nonzero(board)[::-1], axis=1).astype(np.float64)
    projector = np.stack([found.x[board], found.y[board]], axis=1).astype(np.float64)
    H, _ = cv2.findHomography(camera, projector, cv2.RANSAC, 1.0)
    return np.linalg.norm(cv2.perspectiveTransform(camera[:, None], H)[:, 0] - projector, axis=1)


def _board(white: np.ndarray) -> np.ndarray:
    """Pixels inside the corners of the chessboard."""
    _, corners = cv2.findChessboardCorners(white, (7, 9))
    hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(white.shape, np.uint8), hull, (1,)) > 0


def _reprojected(found: Correspondence, board: np.ndarray, folder: Path) -> tuple[float, float]:
    """Points triangulated by the calibration, back in the projector and in the camera: rms distances."""
    file = cv2.FileStorage(str(folder / "calibration_result.xml"), cv2.FILE_STORAGE_READ)
    names = ("cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation")
    K, D, P, E, R, t = (file.getNode(name).mat() for name in names)
    v, u = np.nonzero(board)
    camera = np.stack([u, v], axis=1)[::20].astype(np.float64)
    projector = STEP * np.stack([found.x[board], found.y[board]], axis=1)[::20].astype(np.float64)
    lenses = ((camera, (K, D)), (projector, (P, E)))
    rays = [cv2.undistortPoints(seen[:, None], *lens)[:, 0] for seen, lens in lenses]
    X = cv2.triangulatePoints(np.eye(3, 4), np.hstack([R, t.reshape(3, 1)]), rays[0].T, rays[1].T)
    X = (X[:3] / X[3]).T
    turn = cv2.Rodrigues(R)[0]
    off = (
        cv2.projectPoints(X, turn, t, P, E)[0][:, 0] - projector,
        cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, D)[0][:, 0] - camera,
    )
    back, ahead = (float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in off)
    return back, ahead
