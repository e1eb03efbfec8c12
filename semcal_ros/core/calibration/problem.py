"""The calibration problem: views, priors, and how coefficient functions become an adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.normal_equations import Problem, State, make_problem, whitened_norm
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, design_matrix
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.plane_geometry import mirrored_tilt

__all__ = [
    "Functions",
    "Priors",
    "Setup",
    "adjust",
    "build_problem",
    "constant_functions",
    "prior_vectors",
    "resolve_mirrored_tilts",
    "theta_of",
    "variance_factor",
    "with_coefficients",
]

Functions = Mapping[str, ContinuousFunction]

_JUMPING = ("scale", "aspect", "skew")
_MAX_TURNS = 5
_POSE_ITERATIONS = 12


@dataclass(frozen=True)
class Priors:
    """Weak prior knowledge that holds what the data leave open; kept in the calibration file.

    Attributes
    ----------
    centre_fraction, distortion_centre_fraction
        1-sigma of the principal point and of the distortion centre about the image centre, in image widths.
    rho_mean, rho_sigma
        Inverse pivot distance, 1/m: 20 mm is typical, and 8 mm as well as a parallel projection are within 1.5 sigma.
    xi_r_sigma, xi_t_sigma
        Distortion about zero.
    aspect_sigma, skew_sigma, scale_sigma
        About 1, 0 and the nominal scale.
    scale_jump, aspect_jump, skew_jump
        1-sigma of the jump at a breakpoint.
    scale_change, aspect_change, skew_change, xi_r_change, xi_t_change, centre_change_fraction
        1-sigma of the change with the magnification: of the k-th coefficient of a polynomial, times k squared. A few
        times what tables 2-4 of the paper show for a JSM-820, and for the scale what vendors promise of a
        magnification. What the data cannot tell of a change is uncertain by this much, and not taken for none.
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
        """The same for a lens whose pivot is at a distance of ``1 / rho``, and not some centimetres away.

        Nothing is presumed of distance and heights but their order of magnitude.
        """
        return replace(self, rho_mean=rho, rho_sigma=rho, height_sigma_m=0.3 / rho)


@dataclass(frozen=True)
class Setup:
    """What is common to all problems over one set of views, which are in the order of their magnifications."""

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
        """Scales that the display width alone predicts."""
        return np.asarray(g * self.image_size[0] / self.display_width_m, dtype=np.float64)

    def change_prior_of(self, name: str) -> float:
        """1-sigma of the change of a camera parameter over the calibrated range."""
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
        """Breakpoints of a camera parameter: the amplifiers of the scan change scale, aspect and skew."""
        return np.array(self.breakpoints if name in _JUMPING else (), dtype=np.float64)

    def coefficient_priors(self, name: str, kind: str, size: int) -> tuple[Array, Array]:
        """Means and sigmas of the coefficients of a camera parameter's function, ``size`` without its jumps.

        The constant of a polynomial has the parameter's own prior, the others say how it changes, and the last ones
        how it jumps; all values of a table have the parameter's own.
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
        """(mean, sigma) of a camera parameter."""
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


def build_problem(
    setup: Setup, functions: Functions, views: Sequence[GridView], height_sigma_m: Array | float
) -> Problem:
    """The adjustment of ``views`` with coefficient functions of the given kinds and sizes."""
    nominal = setup.nominal_px_per_m(setup.magnifications)
    designs = np.stack(
        [
            design_matrix(functions, float(g), float(scale))
            for g, scale in zip(setup.magnifications, nominal, strict=True)
        ]
    )
    mean, sigma = prior_vectors(setup, functions)
    return make_problem(
        views,
        setup.magnifications,
        designs,
        norm_px=setup.norm_px,
        nominal_px_per_m=nominal,
        prior_mean=mean,
        prior_sigma=sigma,
        height_sigma_m=height_sigma_m,
    )


def prior_vectors(setup: Setup, functions: Functions) -> tuple[Array, Array]:
    """(K,) means and sigmas of all coefficients, as in :meth:`Setup.coefficient_priors`."""
    parts = [
        setup.coefficient_priors(name, functions[name].kind, functions[name].smooth_size)
        for name in FUNCTION_NAMES
    ]
    return np.concatenate([m for m, _ in parts]), np.concatenate([s for _, s in parts])


def with_coefficients(functions: Functions, theta: Array) -> dict[str, ContinuousFunction]:
    """The functions with the coefficients of a vector in the order of ``FUNCTION_NAMES``."""
    out: dict[str, ContinuousFunction] = {}
    start = 0
    for name in FUNCTION_NAMES:
        stop = start + functions[name].size
        out[name] = replace(functions[name], coefficients=theta[start:stop].copy())
        start = stop
    return out


def constant_functions(setup: Setup, values: Mapping[str, float]) -> dict[str, ContinuousFunction]:
    """Functions that do not depend on the magnification, but for the jumps."""
    g_range = (float(setup.magnifications[0]), float(setup.magnifications[-1]))
    return {
        name: ContinuousFunction(
            "chebyshev_log",
            np.array(
                [values.get(name, setup.prior_of(name)[0]), *np.zeros(len(setup.breaks_of(name)))]
            ),
            g_range,
            breaks=setup.breaks_of(name),
        )
        for name in FUNCTION_NAMES
    }


def theta_of(functions: Functions) -> Array:
    """(K,) all coefficients in the order of ``FUNCTION_NAMES``."""
    return np.concatenate([functions[name].coefficients for name in FUNCTION_NAMES])


def adjust(problem: Problem, state: State, *, tolerance: float = 1e-9) -> BundleResult:
    """Refine, and turn views over to their mirrored tilt as long as that fits better."""
    result = refine(problem, state, tolerance=tolerance)
    for _ in range(_MAX_TURNS):
        turned, changed = resolve_mirrored_tilts(problem, result.state)
        if not changed:
            break
        result = refine(problem, turned, tolerance=tolerance)
    return result


def resolve_mirrored_tilts(problem: Problem, state: State) -> tuple[State, int]:
    """Fit the poses from both signs of the tilt; the better ones, and how many of them are turned over."""
    pairs = zip(problem.starts[:-1], problem.starts[1:], strict=True)
    middle = np.stack([problem.board_m[a:b].mean(axis=0) for a, b in pairs])
    rotations = mirrored_tilt(state.rotations)
    # Turning about the point that is seen in the middle keeps the view in place.
    moved = np.einsum("vij,vj->vi", state.rotations - rotations, middle)
    mirrored = State(state.theta, rotations, state.translations_m + moved)
    own = refine(problem, state, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    other = refine(problem, mirrored, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    if not np.isfinite(other.cost):
        return own.state, 0
    better = _view_costs(problem, other) < _view_costs(problem, own) * (1.0 - 1e-6)
    pick = better[:, None, None]
    turned = State(
        state.theta,
        np.where(pick, other.state.rotations, own.state.rotations),
        np.where(pick[:, 0], other.state.translations_m, own.state.translations_m),
    )
    return turned, int(better.sum())


def _view_costs(problem: Problem, result: BundleResult) -> Array:
    square = whitened_norm(problem, result.residuals_px) ** 2 * result.huber_weight
    height = result.state.translations_m[:, 2] / problem.height_sigma_m
    return np.bincount(problem.view_of_point, weights=square) + height**2


def variance_factor(problem: Problem, result: BundleResult) -> float:
    """Mean square of the whitened residuals per degree of freedom (Huber-weighted)."""
    norm2 = whitened_norm(problem, result.residuals_px) ** 2 * result.huber_weight
    freedom = 2.0 * result.huber_weight.sum() - 6 * len(problem.group) - len(result.state.theta)
    return float(max(norm2.sum() / max(freedom, 1.0), 1e-12))
