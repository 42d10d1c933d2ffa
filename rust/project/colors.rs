//! Colours from spherical harmonics, and their vector-Jacobian product.

use super::{Mask, lanes_in, sh};
use crate::{
    scene::Harmonics,
    simd::{
        Lanes, Real, Wide,
        groups::{self, Column, GROUP, MAX_COLUMNS, Rows, get3, wide3},
        lanes, splat as splat_lanes,
        vec3::V3,
    },
    uninit::{prefetch_all, prefetch_rows},
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// How the colours from harmonics change, for [`backward()`](super::backward()): with it the coefficients, which are most of a
/// scene's memory, are read by the forward pass alone.
#[derive(Debug)]
pub struct Shading<T> {
    /// As `Harmonics::rows`.
    pub(super) rows: (usize, usize),
    /// As `Harmonics::degree`.
    pub(super) degree: usize,
    /// For each group of Gaussians the derivatives of its colours; none at degree 0.
    pub(super) slopes: Vec<Slopes<T>>,
    /// For each group and channel the Gaussians whose colour is clamped at 0.
    pub(super) clamped: Vec<[u16; 3]>,
}

impl<T: Real> Shading<T> {
    /// Send for what a group of Gaussians has.
    #[inline(always)]
    pub(super) fn prefetch(&self, group: usize) {
        for column in self.slopes.get(group).into_iter().flatten() {
            prefetch_all(&column.0);
        }
    }
}

/// Derivatives of channel c along axis a of the unit vector from the camera centre, at 3 c + a, as if its three
/// numbers were free.
pub(super) type Slopes<T> = [Column<T>; 9];

/// Spherical harmonics of a group: 3 k + channel.
pub(super) struct Coefficients<T> {
    columns: [Column<T>; MAX_COLUMNS],
    rows: Rows<T>,
}

impl<T: Real> Coefficients<T> {
    pub const ZERO: Self = Self {
        columns: [Column::ZERO; MAX_COLUMNS],
        rows: Rows::ZERO,
    };

    /// The colours of the Gaussians `first..`, 0 where they are not in `keep`, which loses those whose colour is
    /// not finite. Where there is a place for them: how the colours change, and which are clamped at 0.
    #[inline(always)]
    pub fn shade<S: Simd>(
        &mut self,
        simd: S,
        h: &Harmonics<T>,
        first: usize,
        direction: &[Column<f64>; 3],
        keep: &mut u16,
        mut slopes: Option<&mut Slopes<T>>,
        mut clamped: Option<&mut [u16; 3]>,
    ) -> [Column<T>; 3] {
        self.read(simd, h, first);
        let d = narrow3::<T>(direction);
        let zero = Lanes::<T, S>::splat(simd, T::ZERO);
        let mut rgb = [Column::ZERO; 3];
        for at in (0..GROUP).step_by(Lanes::<T, S>::LEN) {
            let basis = sh::basis::<S, T>(simd, h.degree, get3(simd, &d, at));
            let values = evaluate(simd, h.degree, &self.columns, &basis, at);
            // A sum of finite numbers that overflowed counts as not finite: it is culled either way.
            let finite = values[0].is_finite() & values[1].is_finite() & values[2].is_finite();
            let lanes = ((1u32 << Lanes::<T, S>::LEN) - 1) << at;
            *keep &= !(lanes as u16) | (finite.to_bitmask() as u16) << at;
            for (rgb, value) in rgb.iter_mut().zip(values) {
                rgb.set(simd, at, value.simd_gt(zero).select(value, zero));
            }
            if let Some(clamped) = clamped.as_deref_mut() {
                for (clamped, value) in clamped.iter_mut().zip(values) {
                    let negative = (!value.simd_ge(zero)).to_bitmask() as u16;
                    *clamped |= negative << at;
                }
            }
            if let Some(slopes) = slopes.as_deref_mut() {
                slope(
                    simd,
                    h.degree,
                    &self.columns,
                    get3(simd, &d, at),
                    at,
                    slopes,
                );
            }
        }
        for column in &mut rgb {
            for (lane, x) in column.0.iter_mut().enumerate() {
                *x = if *keep >> lane & 1 == 1 { *x } else { T::ZERO };
            }
        }
        rgb
    }

    /// Send for the coefficients of the group from `first` on.
    #[inline(always)]
    pub fn prefetch(h: &Harmonics<T>, first: usize) {
        let (row, rest_row) = h.rows();
        prefetch_rows(h.coefficients, row, first, GROUP);
        prefetch_rows(h.rest.unwrap_or(&[]), rest_row, first, GROUP);
    }

    /// The coefficients in use of the Gaussians `first..`.
    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, h: &Harmonics<T>, first: usize) {
        let used = 3 * sh::count(h.degree);
        let (row, rest_row) = h.rows();
        if let Some(rest) = h.rest {
            let (low, high) = self.columns.split_first_chunk_mut::<3>().expect("3 of 64");
            groups::read(simd, h.coefficients, first, low);
            self.rows.read(simd, rest, rest_row, first, used - 3, high);
        } else {
            self.rows
                .read(simd, h.coefficients, row, first, used, &mut self.columns);
        }
    }
}

/// Colours of the Gaussians `at..` of a group, before the clamp at 0.
#[inline(always)]
fn evaluate<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    coefficients: &[Column<T>; MAX_COLUMNS],
    basis: &[Lanes<T, S>; sh::MAX_COUNT],
    at: usize,
) -> [Lanes<T, S>; 3] {
    let mut rgb = [Lanes::<T, S>::splat(simd, T::from_f64(0.5)); 3];
    for (k, y) in basis.iter().enumerate().take(sh::count(degree)) {
        rgb[0] = y.mul_add(coefficients[3 * k].get(simd, at), rgb[0]);
        rgb[1] = y.mul_add(coefficients[3 * k + 1].get(simd, at), rgb[1]);
        rgb[2] = y.mul_add(coefficients[3 * k + 2].get(simd, at), rgb[2]);
    }
    rgb
}

/// Derivatives of the colours of the Gaussians `at..` of a group.
#[inline(always)]
fn slope<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    coefficients: &[Column<T>; MAX_COLUMNS],
    direction: V3<Lanes<T, S>>,
    at: usize,
    out: &mut Slopes<T>,
) {
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    for (channel, out) in out.chunks_exact_mut(3).enumerate() {
        let mut weights = [zero; sh::MAX_COUNT];
        for (k, weight) in weights.iter_mut().enumerate().take(sh::count(degree)) {
            *weight = coefficients[3 * k + channel].get(simd, at);
        }
        let g = sh::basis_vjp::<S, T>(simd, degree, direction, &weights);
        for (out, g) in out.iter_mut().zip([g.x, g.y, g.z]) {
            // One that overflowed would make NaN of a cotangent of 0.
            out.set(simd, at, g.is_finite().select(g, zero));
        }
    }
}

/// What the gradients of a group's colours need, a column per number.
pub(super) struct ColorGroup<T> {
    v_coefficients: [Column<T>; 3 * sh::MAX_COUNT],
    /// Unit vectors from the camera centre, and one over the distances.
    directions: [Column<f64>; 3],
    inverses: Column<f64>,
    v_directions: [Column<T>; 3],
}

impl<T: Real> ColorGroup<T> {
    pub const ZERO: Self = Self {
        v_coefficients: [Column::ZERO; 3 * sh::MAX_COUNT],
        directions: [Column::ZERO; 3],
        inverses: Column::ZERO,
        v_directions: [Column::ZERO; 3],
    };

    /// Gradients of the coefficients and of the directions of group `group`, from that of the colours.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &mut self,
        simd: S,
        shading: &Shading<T>,
        group: usize,
        means: &[Column<T>; 3],
        center: V3<Wide<S>>,
        v_colors: &[Column<T>; 3],
        visible: u16,
    ) {
        for at in (0..GROUP).step_by(lanes::<S>()) {
            let (d, inverse) = direction(simd, wide3(simd, means, at), center);
            let valid = lanes_in(simd, visible, at);
            let zero = splat_lanes(simd, 0.0);
            let d = d.only(valid, zero);
            self.directions[0].set(simd, at, d.x);
            self.directions[1].set(simd, at, d.y);
            self.directions[2].set(simd, at, d.z);
            self.inverses.set(simd, at, valid.select(inverse, zero));
        }
        let d = narrow3::<T>(&self.directions);
        let mut v_open = *v_colors;
        for (column, clamped) in v_open.iter_mut().zip(shading.clamped[group]) {
            let open = visible & !clamped;
            for (lane, x) in column.0.iter_mut().enumerate() {
                *x = if open >> lane & 1 == 1 { *x } else { T::ZERO };
            }
        }
        for at in (0..GROUP).step_by(Lanes::<T, S>::LEN) {
            let v = v_open.map(|v| v.get(simd, at));
            let basis = sh::basis::<S, T>(simd, shading.degree, get3(simd, &d, at));
            for (k, y) in basis.iter().enumerate().take(sh::count(shading.degree)) {
                for (channel, v) in v.iter().enumerate() {
                    self.v_coefficients[3 * k + channel].set(simd, at, *y * *v);
                }
            }
            let Some(slopes) = shading.slopes.get(group) else {
                continue; // degree 0: `v_directions` stay 0
            };
            for (axis, v_direction) in self.v_directions.iter_mut().enumerate() {
                let along = v[0] * slopes[axis].get(simd, at);
                let along = v[1].mul_add(slopes[3 + axis].get(simd, at), along);
                let along = v[2].mul_add(slopes[6 + axis].get(simd, at), along);
                v_direction.set(simd, at, along);
            }
        }
    }

    /// Gradient of the means of the Gaussians `at..`, through the normalisation of their directions; a Gaussian on
    /// the camera centre gets none from its colour.
    #[inline(always)]
    pub fn mean_vjp<S: Simd>(&self, simd: S, at: usize, valid: Mask<S>) -> V3<Wide<S>> {
        let d = wide3(simd, &self.directions, at);
        let v_d = wide3(simd, &self.v_directions, at).only(valid, splat_lanes(simd, 0.0));
        (v_d - d.by(d.dot(v_d))).by(self.inverses.wide(simd, at))
    }

    /// Write the gradients of the coefficients to rows of `row` and `rest_row` numbers; 0: not wanted.
    #[inline(always)]
    pub fn write<S: Simd>(
        &self,
        simd: S,
        shading: &Shading<T>,
        [out, rest]: [&mut [T]; 2],
        [row, rest_row]: [usize; 2],
    ) {
        let used = 3 * sh::count(shading.degree);
        let in_first = used.min(shading.rows.0);
        let (v_first, v_rest) = self.v_coefficients[..used].split_at(in_first);
        if row > 0 {
            groups::write_rows(simd, v_first, out, row);
        }
        if rest_row > 0 {
            groups::write_rows(simd, v_rest, rest, rest_row);
        }
    }
}

/// Unit vectors from the camera centre, and one over the distances. A Gaussian on the centre has no direction:
/// both are 0.
#[inline(always)]
pub(super) fn direction<S: Simd>(
    simd: S,
    mean: V3<Wide<S>>,
    center: V3<Wide<S>>,
) -> (V3<Wide<S>>, Wide<S>) {
    let (zero, one) = (splat_lanes(simd, 0.0), splat_lanes(simd, 1.0));
    let d = mean - center;
    let length = d.dot(d).sqrt();
    let inverse = length.simd_gt(zero).select(one / length, zero);
    (d.by(inverse), inverse)
}

/// Three columns in the type of the inputs.
#[inline(always)]
fn narrow3<T: Real>(columns: &[Column<f64>; 3]) -> [Column<T>; 3] {
    let mut out = [Column::ZERO; 3];
    for (out, column) in out.iter_mut().zip(columns) {
        for (o, x) in out.0.iter_mut().zip(column.0) {
            *o = T::from_f64(x);
        }
    }
    out
}
