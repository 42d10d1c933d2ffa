//! A camera in vectors, and the gradient of its pose.

use crate::{
    scene::{Camera, CameraGrad},
    simd::{
        Real, Wide, splat,
        sums::fold,
        vec3::{M3, V3, splat3},
    },
};
use fearless_simd::{Simd, SimdBase, SimdFloat};
use glam::{DMat3, DVec2, DVec3};
use std::ops::Add;

/// A camera, the same in each lane.
pub(crate) struct CameraLanes<S: Simd> {
    pub rotation: M3<Wide<S>>,
    /// Its cofactors: `w_y x w_z`, `w_z x w_x`, `w_x x w_y` of its rows.
    pub cofactors: M3<Wide<S>>,
    pub translation: V3<Wide<S>>,
    pub focal: [Wide<S>; 2],
    pub principal: [Wide<S>; 2],
    pub ratio_min: [Wide<S>; 2],
    pub ratio_max: [Wide<S>; 2],
    pub near: Wide<S>,
    pub far: Wide<S>,
    pub eps2d: Wide<S>,
}

impl<S: Simd> CameraLanes<S> {
    #[inline(always)]
    pub fn new(simd: S, camera: &Camera, near: f64, far: f64, eps2d: f64) -> Self {
        let [r0, r1, r2] = [0, 1, 2].map(|i| camera.rotation.row(i));
        Self {
            rotation: M3([splat3(simd, r0), splat3(simd, r1), splat3(simd, r2)]),
            cofactors: M3([
                splat3(simd, r1.cross(r2)),
                splat3(simd, r2.cross(r0)),
                splat3(simd, r0.cross(r1)),
            ]),
            translation: splat3(simd, camera.translation),
            focal: pair(simd, camera.focal),
            principal: pair(simd, camera.principal),
            ratio_min: pair(simd, camera.ratio_min),
            ratio_max: pair(simd, camera.ratio_max),
            near: splat(simd, near),
            far: splat(simd, far),
            eps2d: splat(simd, eps2d),
        }
    }

    /// A point of the world in the camera frame. In f64 the far-off origin of a geo-referenced scene takes the
    /// digits away, so that the roundings are added back; inputs in f32 have none to lose.
    #[inline(always)]
    pub fn point<T: Real>(&self, p: V3<Wide<S>>) -> V3<Wide<S>> {
        if T::SINGLE {
            return self.rotation.times(p) + self.translation;
        }
        let [r0, r1, r2] = self.rotation.0;
        V3::new(
            dot_plus(r0, p, self.translation.x),
            dot_plus(r1, p, self.translation.y),
            dot_plus(r2, p, self.translation.z),
        )
    }
}

/// `a . b + c` as if computed with twice the digits (Ogita, Rump, Oishi 2005, Dot2).
#[inline(always)]
fn dot_plus<S: Simd, V: SimdFloat<S>>(a: V3<V>, b: V3<V>, c: V) -> V {
    let products = [a.x * b.x, a.y * b.y, a.z * b.z];
    let mut lost = a.x.mul_sub_precise(b.x, products[0])
        + a.y.mul_sub_precise(b.y, products[1])
        + a.z.mul_sub_precise(b.z, products[2]);
    let mut sum = c;
    for product in products {
        let next = sum + product;
        let added = next - sum;
        lost += (sum - (next - added)) + (product - added);
        sum = next;
    }
    sum + lost
}

/// Gradient of the camera, a sum per lane.
#[derive(Clone, Copy)]
pub(crate) struct CameraGradLanes<S: Simd> {
    pub rotation: [V3<Wide<S>>; 3],
    pub translation: V3<Wide<S>>,
    pub center: V3<Wide<S>>,
}

impl<S: Simd> CameraGradLanes<S> {
    #[inline(always)]
    pub fn zero(simd: S) -> Self {
        let zero = splat3(simd, DVec3::ZERO);
        Self {
            rotation: [zero; 3],
            translation: zero,
            center: zero,
        }
    }

    /// Sum of the lanes of all parts.
    #[inline(always)]
    pub fn sum(parts: &mut [Self]) -> CameraGrad {
        let all = fold(parts);
        let [r0, r1, r2] = all.rotation;
        CameraGrad {
            rotation: DMat3::from_cols(sum::<S>(r0), sum::<S>(r1), sum::<S>(r2)).transpose(),
            translation: sum::<S>(all.translation),
            center: sum::<S>(all.center),
        }
    }
}

impl<S: Simd> Add for CameraGradLanes<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        let ([a0, a1, a2], [b0, b1, b2]) = (self.rotation, o.rotation);
        Self {
            rotation: [a0 + b0, a1 + b1, a2 + b2],
            translation: self.translation + o.translation,
            center: self.center + o.center,
        }
    }
}

#[inline(always)]
fn sum<S: Simd>(v: V3<Wide<S>>) -> DVec3 {
    DVec3::new(v.x.reduce_sum(), v.y.reduce_sum(), v.z.reduce_sum())
}

#[inline(always)]
fn pair<S: Simd>(simd: S, v: DVec2) -> [Wide<S>; 2] {
    [splat(simd, v.x), splat(simd, v.y)]
}
