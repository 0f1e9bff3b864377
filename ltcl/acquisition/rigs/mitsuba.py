# SPDX-License-Identifier: BSD-3-Clause
"""`MitsubaRig`: photographs of a scene in Mitsuba 3 (extra `rig`), lit by its projector emitter.

    p_d = b + (1 - b) g_d(x_d)          projector: codes x (h, w[, 3]) through response g, light b at code 0
    L                                   the renderer's radiance under p, (H, W, 3)
    v = max(sensitivity seconds L, 0)   linear sensor value, which `sensor` makes codes of

Every pattern is rendered with the same seed: paths depend on the scene, not on the pattern, so radiance is
linear in p, without noise between photographs, as it is before a scene that stands still. What the renderer's
own noise leaves is a T that differs a little from the true one, and consistently. Noise of photographs comes
from the sensor alone, by codes, seconds and repeat, as in `VirtualRig`.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import as_codes, as_seconds
from ltcl.acquisition.rigs import curves, extras
from ltcl.acquisition.rigs.mitsuba_loading import line, load, variant_of
from ltcl.acquisition.rigs.mitsuba_scenes import SCENES, within
from ltcl.acquisition.rigs.noise import NoiseStreams
from ltcl.acquisition.rigs.sensor import Sensor
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_BRIGHT, _FULL = 99.0, 0.5  # percentile of the picture in white light, and the share of a pixel it shall fill


class MitsubaRig:
    """A projector and a camera in a scene that Mitsuba 3 renders.

    Parameters
    ----------
    scene : "dihedral", "trihedral", "box", dict or path
        A name of `mitsuba_scene`; or a dict for `mitsuba.load_dict` or an XML file, with one emitter of type
        "projector" and one sensor. The projector's `irradiance` is replaced; other emitters are ambient
        light.
    projector_grid : (h, w)
    camera_grid : (H, W), optional
        Of the photographs; if omitted, what the film of the scene has, or `projector_grid` of a named scene.
    channels : 1 or 3
        Of codes and photographs; one channel is the green one.
    samples : int
        Paths for each camera pixel.
    variant : "auto" or the name of an RGB variant
        Of Mitsuba. "auto" is llvm_ad_rgb where a trial in a process of its own renders, else scalar_rgb.
    response, projector_response, bits, black, projector_black, gain, read, exposures
        As of `VirtualRig`.
    sensitivity : float, optional
        Linear sensor value for radiance 1 in one second; None: the brightest hundredth of the picture in
        white light fills half a pixel in one second.
    seed : int
        Of the paths and of the noise.

    Raises
    ------
    InputError, InputTypeError
        A scene that Mitsuba cannot load, or without one projector and one sensor; a number out of range.
    FileError
        There is no such XML file.
    AcquisitionError
        Mitsuba is not installed.

    Examples
    --------
    >>> rig = MitsubaRig("dihedral", (12, 16), samples=16, variant="scalar_rgb")
    >>> white = np.ones((12, 16))
    >>> rig.photograph(white, seconds=1.0).shape
    (12, 16, 3)
    >>> bool(np.allclose(rig.radiance(white), rig.radiance(white)))
    True
    """

    def __init__(
        self,
        scene: Any,
        projector_grid: tuple[int, int],
        *,
        camera_grid: tuple[int, int] | None = None,
        channels: int = 3,
        samples: int = 64,
        variant: str = "auto",
        response: Any = "srgb",
        projector_response: Any = "srgb",
        bits: int | str = 8,
        black: float = 0.004,
        projector_black: float = 0.0,
        gain: float | None = 10000.0,
        read: float = 0.0005,
        sensitivity: float | None = None,
        exposures: Any = None,
        seed: int = 0,
    ) -> None:
        self.projector_grid = checks.grid("projector_grid", projector_grid)
        self.channels = checks.one_of("channels", channels, (1, 3))
        self._samples = checks.count("samples", samples)
        self._projector = curves.projector(projector_response, channels)
        self._sensor = Sensor(curves.camera(response, channels), bits, black, gain, read)
        self._projector_black = checks.number("projector_black", projector_black, least=0.0, below=1.0)
        self._noise = NoiseStreams(seed)
        self.exposures = None if exposures is None else tuple(exposures)
        self._named = {"response": curves.called(response), "projector": curves.called(projector_response)}
        camera_grid = None if camera_grid is None else checks.grid("camera_grid", camera_grid)
        self._called = _called(scene)
        self._mi = extras.load("mitsuba", "rig", "MitsubaRig")
        self._variant = variant_of(self._mi, variant)
        self._loaded = load(self._mi, self._variant, scene, self.projector_grid, camera_grid)
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # brackets ask for the same codes again
        if sensitivity is None:
            self._sensitivity = self._measured()
        else:
            self._sensitivity = checks.number("sensitivity", sensitivity, above=0.0)

    @property
    def bits(self) -> int | None:
        """Of the codes; None of a float camera."""
        return self._sensor.bits if isinstance(self._sensor.bits, int) else None

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Codes of the camera after `seconds` of light under `codes`, (H, W) or (H, W, 3).

        Parameters
        ----------
        codes : (h, w), or (h, w, 3) of a rig with three channels
            In [0, 1]; (h, w) feeds all channels alike.
        seconds : float
            Of exposure.

        Returns
        -------
        np.ndarray
            uint8, uint16 or float32.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1]; seconds that are not positive.
        AcquisitionError
            The renderer failed, or gave what is not finite.
        """
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        value = self._sensitivity * seconds * self.radiance(codes)
        return self._sensor.expose(np.maximum(value, 0.0), self._noise.of(codes, seconds))

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Pass over the noise of a photograph that was taken in an earlier session."""
        self._noise.of(as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds))

    def radiance(self, codes: Any) -> np.ndarray:
        """L, without a sensor: float64, (H, W) or (H, W, 3). What the photographs are to be compared with.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1].
        AcquisitionError
            The renderer failed, or gave what is not finite.
        """
        codes = as_codes(codes, self.projector_grid, self.channels)
        if self._last is None or not np.array_equal(self._last[0], codes):
            self._last = codes.copy(), self._rendered(self._light(codes))
        return self._last[1].copy()

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        sensor = self._sensor
        return {
            "kind": "mitsuba",
            "scene": self._called,
            "mitsuba": str(self._mi.__version__),
            "variant": self._variant,
            "samples": self._samples,
            "projector_grid": list(self.projector_grid),
            "channels": self.channels,
            "response": self._named["response"],
            "projector_response": self._named["projector"],
            "bits": sensor.bits,
            "black": sensor.black,
            "projector_black": self._projector_black,
            "gain": sensor.electrons,
            "read": sensor.read,
            "sensitivity": self._sensitivity,
            "seed": self._noise.seed,
        }

    def _light(self, codes: np.ndarray) -> np.ndarray:
        """p, float32 (h, w, 3)."""
        fed = np.broadcast_to(codes[..., None] if codes.ndim == 2 else codes, (*codes.shape[:2], 3))
        g = self._projector * (3 // len(self._projector))
        lit = np.stack([g[d](fed[..., d].astype(np.float64)) for d in range(3)], axis=-1)
        return (self._projector_black + (1.0 - self._projector_black) * lit).astype(np.float32)

    def _rendered(self, p: np.ndarray) -> np.ndarray:
        mi, (scene, parameters, irradiance) = self._mi, self._loaded
        with within(mi, self._variant):
            try:
                parameters[irradiance] = mi.TensorXf(np.ascontiguousarray(p))
                parameters.update()
                image = np.array(mi.render(scene, spp=self._samples, seed=self._noise.seed), np.float64)
            except RuntimeError as error:
                raise AcquisitionError(f"Mitsuba cannot render the scene: {line(error)}") from error
        if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(image).all():
            raise AcquisitionError(f"Mitsuba rendered {image.shape}, or NaN; it must be finite (H, W, 3)")
        return image[..., 1] if self.channels == 1 else image[..., :3]

    def _measured(self) -> float:
        bright = float(np.percentile(self.radiance(np.ones(self.projector_grid)), _BRIGHT))
        if bright <= 0:
            raise InputError("scene shows no light of its projector; projector and sensor must see the same")
        return _FULL / bright


def _called(scene: Any) -> str:
    if isinstance(scene, dict):
        return "dict"
    if isinstance(scene, (str, os.PathLike)):
        return os.path.basename(os.fspath(scene))  # a name of ours is its own
    raise InputTypeError(
        f"scene is a {type(scene).__name__}; it must be one of {', '.join(SCENES)}, a dict or an XML file"
    )
