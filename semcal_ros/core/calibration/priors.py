"""Knowledge before a calibration: weak priors, and the setup that all problems share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import GridView

__all__ = ["Priors", "Setup"]


# The amplifiers of the scan change these at a breakpoint.
_JUMPING = ("scale", "aspect", "skew")


@dataclass(frozen=True)
class Priors:
    """Weak prior knowledge that holds what the data leave open; stored in the calibration file.

    Attributes
    ----------
    centre_fraction, distortion_centre_fraction
        1-sigma of the principal point and of the distortion centre about the image centre, in image
        widths.
    rho_mean, rho_sigma
        Inverse pivot distance, 1/m: 20 mm is typical, and 8 mm as well as a parallel projection are
        within 1.5 sigma.
    xi_r_sigma, xi_t_sigma
        Distortion about zero.
    aspect_sigma, skew_sigma, scale_sigma
        About 1, 0 and the nominal scale.
    scale_jump, aspect_jump, skew_jump
        1-sigma of the jump at a breakpoint.
    scale_change, aspect_change, skew_change, xi_r_change, xi_t_change, centre_change_fraction
        1-sigma of the change with the magnification: of the k-th coefficient of a polynomial, times
        k squared. A few times what tables 2-4 of the paper show for a JSM-820, and for the scale
        what vendors promise of a magnification. A change that the data do not determine is
        uncertain by this much, and not assumed to be zero.
    """

    centre_fraction: float = 0.08
    distortion_centre_fraction: float = 0.15
    rho_mean: float = 50.0
    rho_sigma: float = 60.0
    xi_r_sigma: float = 0.3
    xi_t_sigma: float = 0.1
    aspect_sigma: float = 0.05
    skew_sigma: float = 0.02
    scale_sigma: float = 0.5
    scale_change: float = 0.02
    aspect_change: float = 0.01
    skew_change: float = 0.002
    xi_r_change: float = 0.02
    xi_t_change: float = 0.005
    centre_change_fraction: float = 0.02
    scale_jump: float = 0.03
    aspect_jump: float = 0.01
    skew_jump: float = 0.005
    height_sigma_m: float = 1e-4

    def of_wide_views(self, rho: float) -> Priors:
        """Return the priors of a lens with the pivot at ``1 / rho`` and not a few centimetres away.

        Only the order of magnitude of the distance and of the heights is presumed.
        """
        return replace(self, rho_mean=rho, rho_sigma=rho, height_sigma_m=0.3 / rho)


@dataclass(frozen=True)
class Setup:
    """Everything common to all problems over one set of views, in order of their magnifications."""

    views: tuple[GridView, ...]
    magnifications: Array
    image_size: tuple[int, int]
    display_width_m: float
    priors: Priors
    breakpoints: tuple[float, ...] = ()

    @property
    def norm_px(self) -> float:
        """Half the image width, px."""
        return 0.5 * self.image_size[0]

    @property
    def centre_px(self) -> Array:
        """(2,) middle of the image."""
        return 0.5 * (np.array(self.image_size, dtype=np.float64) - 1.0)

    def nominal_px_per_m(self, g: Array) -> Array:
        """Return the scales in px per m that the display width alone predicts."""
        return g * self.image_size[0] / self.display_width_m

    def change_prior_of(self, name: str) -> float:
        """Return the 1-sigma of the change of a camera parameter over the calibrated range."""
        p = self.priors
        centre = p.centre_change_fraction * self.image_size[0]
        return {
            "scale": p.scale_change,
            "aspect": p.aspect_change,
            "skew": p.skew_change,
            "xi_r": p.xi_r_change,
            "xi_t": p.xi_t_change,
            "ex": centre,
            "ey": centre,
        }.get(name, self.prior_of(name)[1])

    def breaks_of(self, name: str) -> Array:
        """Return the breakpoints of a camera parameter: only scale, aspect and skew have any."""
        return np.array(self.breakpoints if name in _JUMPING else (), dtype=np.float64)

    def coefficient_priors(self, name: str, kind: str, size: int) -> tuple[Array, Array]:
        """Return means and sigmas of the coefficients of a function, ``size`` without its jumps.

        The constant of a polynomial has the prior of the parameter, the next coefficients have the
        prior of its change, and the last ones that of its jumps; all values of a table have the
        prior of the parameter.
        """
        mean, sigma = self.prior_of(name)
        if kind == "linear_log":
            return np.full(size, mean), np.full(size, sigma)
        p, order, jumps = self.priors, np.arange(1, size), len(self.breaks_of(name))
        jump = {"scale": p.scale_jump, "aspect": p.aspect_jump, "skew": p.skew_jump}.get(name, 0.0)
        # The coefficients of a smooth function fall quickly.
        change = self.change_prior_of(name) / order**2
        sigmas = [np.array([sigma]), change, np.full(jumps, jump)]
        return np.concatenate([[mean], np.zeros(size - 1 + jumps)]), np.concatenate(sigmas)

    def prior_of(self, name: str) -> tuple[float, float]:
        """Return (mean, sigma) of a camera parameter."""
        p, width = self.priors, self.image_size[0]
        cx, cy = self.centre_px
        return {
            "scale": (1.0, p.scale_sigma),
            "aspect": (1.0, p.aspect_sigma),
            "skew": (0.0, p.skew_sigma),
            "px": (cx, p.centre_fraction * width),
            "py": (cy, p.centre_fraction * width),
            "rho": (p.rho_mean, p.rho_sigma),
            "xi_r": (0.0, p.xi_r_sigma),
            "xi_t": (0.0, p.xi_t_sigma),
            "ex": (cx, p.distortion_centre_fraction * width),
            "ey": (cy, p.distortion_centre_fraction * width),
        }[name]
