# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What is known before a calibration, and the adjustment of coefficient functions that follows from it.

:class:`Setup` has what all problems share, the weak priors among it, and :func:`build_problem` makes the adjustment of
functions of given kinds and sizes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.estimator.blocks import (
    MISS_NAMES,
    Effects,
    Problem,
    State,
    make_problem,
)
from semcal_ros.core.calibration.estimator.thresholds import REFERENCE_WIDTH_PX
from semcal_ros.core.calibration.stage import StageAxis, attitudes
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import (
    ALL_FUNCTIONS,
    FUNCTION_NAMES,
    design_matrix,
    names_of,
    stack_coefficients,
)
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.distortion import LATE_TERMS
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES, Raster

SCAN_GAINS = ("scale", "aspect", "skew")
"""The functions that the amplifiers of the scan set at each magnification: they may jump, where lenses change smoothly.
"""


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
    xi_r_sigma, xi_t_sigma, xi_s_sigma, scan_sigma
        Distortion about zero, of the lens and of the scan: the latter is some px at a width of 512. ``xi_t`` stands for
        all decentring and for the radial distortion of the fifth order.
    aspect_sigma, skew_sigma, scale_sigma
        About 1, 0 and the nominal scale.
    scale_jump, aspect_jump, skew_jump
        1-sigma of the jump at a breakpoint.
    scale_change, aspect_change, skew_change, xi_r_change, xi_t_change, xi_s_change, scan_change
    centre_change_fraction
        1-sigma of the change with the magnification: of the k-th coefficient of a polynomial, times k squared, over a
        decade and more. A few times what tables 2-4 of the paper show for a JSM-820, and for the scale what vendors
        promise of a magnification. A change that the data do not determine is uncertain by this much, and not assumed
        to be zero.
    height_sigma_m
        Height of a view: a tenth of a millimetre is what a stage that is not quite eucentric adds.
    visit_scale_sigma, visit_height_sigma_m, drift_sigma_px
        Usual spread of the scale and the height from visit to visit, and of the drift within an
        image: one tenth of a per cent is a good microscope, and twenty micrometres the depth of
        focus at a low magnification. They count as one observation.
    axis_miss_sigma_m
        How far the tilt axis misses the specimen, per direction.
    grid_stretch_sigma, grid_shear_sigma, grid_curvature_sigma, square_ratio_sigma
        Shape of the grid: lithography keeps its axes equal and at right angles, and the sizes of its
        squares, to about 1 part in 2000, and a chip has a radius of curvature of a metre and more.
        Views override these by far where they say something else.
    stage_tilt_sigma, stage_axis_sigma, stage_wedge_sigma, untilted_sigma_rad
        Constant error of the tilt of a stage (half a degree) and of the direction of its axis (two
        degrees), the wedge between specimen and stage, and the tilt of an untilted view.
    """

    centre_fraction: float = 0.08
    distortion_centre_fraction: float = 0.15
    rho_mean: float = 50.0
    rho_sigma: float = 60.0
    xi_r_sigma: float = 0.3
    xi_t_sigma: float = 0.1
    xi_s_sigma: float = 0.05
    scan_sigma: float = 0.02
    aspect_sigma: float = 0.05
    skew_sigma: float = 0.02
    scale_sigma: float = 0.5
    scale_change: float = 0.02
    aspect_change: float = 0.01
    skew_change: float = 0.002
    xi_r_change: float = 0.02
    xi_t_change: float = 0.005
    xi_s_change: float = 0.01
    scan_change: float = 0.002
    centre_change_fraction: float = 0.02
    scale_jump: float = 0.03
    aspect_jump: float = 0.01
    skew_jump: float = 0.005
    height_sigma_m: float = 1e-4
    visit_scale_sigma: float = 1e-3
    visit_height_sigma_m: float = 2e-5
    drift_sigma_px: float = 0.1
    axis_miss_sigma_m: float = 3e-4
    grid_stretch_sigma: float = 5e-4
    grid_shear_sigma: float = 5e-4
    grid_curvature_sigma: float = 1.0
    square_ratio_sigma: float = 5e-4
    stage_tilt_sigma: float = 0.0087
    stage_axis_sigma: float = 0.035
    stage_wedge_sigma: float = 0.0087
    untilted_sigma_rad: float = 0.0087
    is_wide: bool = False

    def of_photographs(self, rho: float) -> Priors:
        """Return the priors of a lens with the pivot at ``1 / rho`` and not a few centimetres away.

        Only the order of magnitude of the distance and of the heights is presumed.
        """
        return replace(self, rho_mean=rho, rho_sigma=rho, height_sigma_m=0.3 / rho, is_wide=True)


@dataclass(frozen=True)
class Setup:
    """Everything common to all problems over one set of views, in order of their magnifications.

    With ``shared`` unknowns (see :class:`~semcal_ros.core.calibration.estimator.blocks.Problem`),
    the problems also have the effects of visits and of drift within the images.
    ``stage_rotation_rad`` is where the constant error of the stage's rotation starts. ``tempering`` is by how much less
    than stated the readings of the stage are believed, as long as the corners are: else a wrong reading would win.
    ``corrected`` says that a residual field has been taken off the corners.
    """

    views: tuple[GridView, ...]
    magnifications: Array
    image_size: tuple[int, int]
    display_width_m: float
    priors: Priors
    breakpoints: tuple[float, ...] = ()
    shared: tuple[str, ...] = ()
    axis: StageAxis = field(default_factory=StageAxis)
    stage_rotation_rad: float = 0.0
    tempering: float = 1.0
    raster_ratio: float | None = None
    corrected: bool = False

    @property
    def raster(self) -> Raster:
        """Where the raster lies in the pictures; ``raster_ratio`` is that of an older calibration."""
        whole = Raster.of(*self.image_size)
        return whole if self.raster_ratio is None else replace(whole, ratio=self.raster_ratio)

    @property
    def drift_sigma_px(self) -> float:
        """Usual drift within an image, 1-sigma per axis in px: the same part of the field in all sizes of images."""
        return self.priors.drift_sigma_px * self.image_size[0] / REFERENCE_WIDTH_PX

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

    @property
    def visits(self) -> tuple[Indices, Indices]:
        """(V,) visit of each view, and (J,) index of the magnification of each visit."""
        keys = [(float(v.magnification), v.visit) for v in self.views]
        known = sorted(set(keys))
        visit = np.array([known.index(key) for key in keys], dtype=np.intp)
        return visit, np.searchsorted(self.magnifications, [g for g, _ in known]).astype(np.intp)

    @property
    def is_lattice_known(self) -> bool:
        """Whether all views have the axes of the grid.

        They do where the stage says of each how far it is turned, and where they show parallel lines.
        """
        return all(
            v.across is not None
            or (v.has_stage_tilt and v.stage is not None and v.stage.rotation_rad is not None)
            for v in self.views
        )

    @property
    def squares_m(self) -> tuple[float, ...]:
        """Sizes of squares, the most frequent one first: the others are compared with it."""
        counts = Counter(v.square_m for v in self.views)
        return tuple(size for size, _ in counts.most_common())

    def shared_priors(self) -> tuple[Array, Array]:
        """Return means and sigmas of the shared unknowns."""
        p = self.priors
        sigmas = {
            "grid_stretch": p.grid_stretch_sigma,
            "grid_shear": p.grid_shear_sigma,
            "grid_curvature_m": p.grid_curvature_sigma,
            "stage_tilt": p.stage_tilt_sigma,
            "stage_axis": p.stage_axis_sigma,
            # The grid may lie on the stage in any direction.
            "stage_rotation": np.pi,
            "stage_wedge_x": p.stage_wedge_sigma,
            "stage_wedge_y": p.stage_wedge_sigma,
            **dict.fromkeys(MISS_NAMES, p.axis_miss_sigma_m),
        }
        sigma = [sigmas.get(name, p.square_ratio_sigma) for name in self.shared]
        return np.zeros(len(sigma)), np.array(sigma, dtype=np.float64)

    def shared_start(self) -> Array:
        """Return the values at which the shared unknowns start."""
        return np.array(
            [self.stage_rotation_rad if name == "stage_rotation" else 0.0 for name in self.shared]
        )

    def change_prior_of(self, name: str) -> float:
        """Return the 1-sigma of the change of a camera parameter over the calibrated range."""
        p = self.priors
        centre = p.centre_change_fraction * self.image_size[0]
        constants = ("px", "py", "rho")
        return {
            "scale": p.scale_change,
            "aspect": p.aspect_change,
            "skew": p.skew_change,
            "xi_r": p.xi_r_change,
            "xi_t": p.xi_t_change,
            "xi_s": p.xi_s_change,
            **dict.fromkeys(("xi_u", *LATE_TERMS), p.xi_t_change),
            "ex": centre,
            "ey": centre,
            **dict.fromkeys(SCAN_NAMES, p.scan_change),
            **{constant: self.prior_of(constant)[1] for constant in constants},
        }[name]

    def breaks_of(self, name: str) -> Array:
        """Return the breakpoints of a camera parameter: only scale, aspect and skew have any."""
        return np.array(self.breakpoints if name in SCAN_GAINS else (), dtype=np.float64)

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
        change = self.change_prior_of(name) * self._bend**order / order**2
        sigmas = [np.array([sigma]), change, np.full(jumps, jump)]
        return np.concatenate([[mean], np.zeros(size - 1 + jumps)]), np.concatenate(sigmas)

    @property
    def _bend(self) -> float:
        """By how much less a function changes over these magnifications than over a decade; at most 1.

        The coefficients of a smooth function fall with the power of the length of its interval that is their order.
        """
        low, high = self.magnifications[[0, -1]]
        return float(np.clip(np.log10(high / low), 0.05, 1.0))

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
            "xi_s": (0.0, p.xi_s_sigma),
            **dict.fromkeys(("xi_u", *LATE_TERMS), (0.0, p.xi_t_sigma)),
            **dict.fromkeys(SCAN_NAMES, (0.0, p.scan_sigma)),
        }[name]


@dataclass(frozen=True)
class Spread:
    """A standard deviation, and how well it is known.

    Attributes
    ----------
    sigma
        The standard deviation.
    determined
        How many of the effects the data determine; the relative 1-sigma of ``sigma`` is
        ``1 / sqrt(2 determined)``.
    visible
        How many of them the data would determine if the spread were the usual one: few where the
        data say nothing about the spread, and many where they say that it is small.
    """

    sigma: float
    determined: float
    visible: float = 0.0

    @property
    def sigma_of_sigma(self) -> float:
        """1-sigma of ``sigma``; infinite where the data say nothing."""
        return self.sigma / np.sqrt(2.0 * self.determined) if self.determined > 0.0 else np.inf


@dataclass(frozen=True)
class VarianceComponents:
    """Spread of all random effects.

    Attributes
    ----------
    scale
        Relative scale of a visit.
    visit_height
        Height that the views of a visit share, m.
    height_sigma_m
        (V,) height of each view, m.
    drift_sigma_px
        (V,) drift within each image, px per axis.
    lattice_sigma
        (2,) stretch and shear of the grid in the lattice of a view, which has one of four
        directions by chance; None where all views have the axes of the grid.
    """

    scale: Spread
    visit_height: Spread
    height_sigma_m: Array
    drift_sigma_px: Array
    lattice_sigma: Array | None = None


def initial_components(setup: Setup) -> VarianceComponents:
    """Return the usual spreads."""
    count, priors = len(setup.views), setup.priors
    return VarianceComponents(
        Spread(priors.visit_scale_sigma, 0.0),
        Spread(priors.visit_height_sigma_m, 0.0),
        np.full(count, priors.height_sigma_m),
        np.full(count, setup.drift_sigma_px),
        None if setup.is_lattice_known else usual_lattice_sigmas(priors),
    )


def usual_lattice_sigmas(priors: Priors) -> Array:
    """Return the usual (2,) sigmas of stretch and shear in the lattice of a view."""
    return np.array([priors.grid_stretch_sigma, priors.grid_shear_sigma])


Functions = Mapping[str, ContinuousFunction]


def build_problem(
    setup: Setup,
    functions: Functions,
    views: Sequence[GridView],
    spread: VarianceComponents | float,
    *,
    candidates: Sequence[str] = (),
) -> Problem:
    """Set up the adjustment of ``views`` with functions of the given kinds and sizes.

    Given one number, the 1-sigma of the heights, it has neither shared unknowns nor effects. ``candidates`` are
    parameters without a function, of which only the information is asked.
    """
    nominal = setup.nominal_px_per_m(setup.magnifications)
    rows = tuple(name for name in ALL_FUNCTIONS if name in functions or name in candidates)
    designs = np.stack(
        [
            design_matrix(functions, float(g), float(scale), rows)
            for g, scale in zip(setup.magnifications, nominal, strict=True)
        ]
    )
    mean, sigma = prior_vectors(setup, functions)
    shared = () if isinstance(spread, float) else setup.shared
    if shared:
        designs = with_shared(designs, len(shared))
        own_mean, own_sigma = setup.shared_priors()
        mean, sigma = np.concatenate([mean, own_mean]), np.concatenate([sigma, own_sigma])
    problem = make_problem(
        views,
        setup.magnifications,
        designs,
        raster=setup.raster,
        parameters=tuple(ALL_NAMES[ALL_FUNCTIONS.index(name)] for name in rows),
        nominal_px_per_m=nominal,
        prior_mean=mean,
        prior_sigma=sigma,
        height_sigma_m=spread if isinstance(spread, float) else spread.height_sigma_m,
    )
    if not shared or isinstance(spread, float):
        return problem
    visit, visit_group = setup.visits
    height = setup.image_size[1]
    y = np.concatenate([v.image_xy[:, 1] for v in views])
    effects = Effects(
        visit,
        visit_group,
        spread.scale.sigma,
        spread.visit_height.sigma,
        spread.drift_sigma_px,
        (y - 0.5 * (height - 1)) / height,
        spread.lattice_sigma,
    )
    known = attitudes(
        [v.stage for v in views],
        [v.untilted for v in views],
        setup.axis,
        setup.priors.untilted_sigma_rad,
    )
    known = replace(known, sigma_rad=setup.tempering * known.sigma_rad)
    sizes = setup.squares_m
    return replace(
        problem,
        shared=shared,
        square_class=np.array([sizes.index(v.square_m) for v in views], dtype=np.intp),
        effects=effects,
        attitudes=known if known.say_anything else None,
    )


def with_shared(designs: Array, count: int) -> Array:
    """Return designs (M, P, K) with ``count`` more unknowns, the same at every magnification."""
    groups, rows, columns = designs.shape
    out = np.zeros((groups, rows + count, columns + count))
    out[:, :rows, :columns] = designs
    out[:, np.arange(rows, rows + count), np.arange(columns, columns + count)] = 1.0
    return out


def with_shared_values(functions: Functions, theta: Array, shared: int) -> Array:
    """Return the coefficients of the functions, followed by the last ``shared`` values of theta."""
    return np.concatenate([stack_coefficients(functions), theta[len(theta) - shared :]])


def prior_vectors(setup: Setup, functions: Functions) -> tuple[Array, Array]:
    """Return (K,) means and sigmas of all coefficients, as in :meth:`Setup.coefficient_priors`."""
    parts = [
        setup.coefficient_priors(name, functions[name].kind, functions[name].smooth_size)
        for name in names_of(functions)
    ]
    return np.concatenate([m for m, _ in parts]), np.concatenate([s for _, s in parts])


def constant_functions(
    setup: Setup, values: Mapping[str, float], names: Sequence[str] = FUNCTION_NAMES
) -> dict[str, ContinuousFunction]:
    """Make functions that do not depend on the magnification, except for their jumps."""
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
        for name in names
    }


def stack_theta(setup: Setup, functions: Functions, state: State) -> Array:
    """Return the coefficients of the functions, followed by the shared unknowns of a state."""
    return with_shared_values(functions, state.theta, len(setup.shared))
