//! What the scenes of tests and benchmarks are.

use super::synthetic::Synthetic;
use glam::{DQuat, DVec3};
use std::f64::consts::PI;

#[test]
fn the_room_is_made_of_thin_gaussians_on_its_surfaces() {
    let n = 4000;
    let s = Synthetic::<f64>::room(n, 50, 40, 3).unwrap();
    let on_spheres = |p: DVec3| {
        [
            (DVec3::new(-0.7, 0.7, 3.2), 0.7),
            (DVec3::new(0.8, 0.9, 2.4), 0.5),
        ]
        .map(|(center, radius)| ((p - center).length() - radius).abs() < 1e-12)
    };
    let mut on = [0; 3]; // the walls, each sphere
    for i in 0..n {
        let p = DVec3::from_slice(&s.means[3 * i..]);
        let [w, x, y, z] = [0, 1, 2, 3].map(|k| s.quats[4 * i + k]);
        let thin = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
        let scales = &s.scales[3 * i..3 * i + 3];
        assert!(scales[2] < 0.3 * scales[0].min(scales[1]));
        let spheres = on_spheres(p);
        if let Some(k) = spheres.iter().position(|on| *on) {
            on[k + 1] += 1;
            let center = [DVec3::new(-0.7, 0.7, 3.2), DVec3::new(0.8, 0.9, 2.4)][k];
            assert!((thin.dot((p - center).normalize()) - 1.0).abs() < 1e-9);
        } else {
            on[0] += 1;
            let walls = [
                (p.x.abs() - 2.0, thin.x),
                (p.y.abs() - 1.4, thin.y),
                ((p.z - 2.0).abs() - 3.0, thin.z),
            ];
            assert!(
                walls
                    .iter()
                    .any(|(d, n)| d.abs() < 1e-12 && (n.abs() - 1.0).abs() < 1e-9)
            );
        }
    }
    // By area: 104 of the walls, 4 pi 0.49 and 4 pi 0.25 of the spheres, each within 4 standard deviations.
    let areas = [104.0, 4.0 * PI * 0.49, 4.0 * PI * 0.25];
    let total: f64 = areas.iter().sum();
    for (count, area) in on.into_iter().zip(areas) {
        let expected = n as f64 * area / total;
        assert!(
            (f64::from(count) - expected).abs() < 4.0 * expected.sqrt(),
            "{on:?}"
        );
    }
}

#[test]
fn most_of_the_room_is_in_view_and_hides_what_lies_behind() {
    let s = Synthetic::<f32>::room(20_000, 150, 100, 1).unwrap();
    let harmonics = crate::scene::Harmonics {
        coefficients: &s.harmonics,
        rest: None,
        stored: 16,
        degree: 3,
    };
    let options = crate::project::RenderOptions::default();
    let colors = crate::scene::Colors::Harmonics(harmonics);
    let r = crate::render::forward(s.gaussians(), colors, None, &s.camera, &options).unwrap();
    let open = r.alphas.iter().filter(|a| **a < 0.9).count();
    assert!(
        open < r.alphas.len() / 20,
        "{open} pixels see through the walls"
    );
    let seen = r.radii.chunks_exact(2).filter(|r| r[0] > 0).count();
    assert!(
        (6_000..18_000).contains(&seen),
        "{seen} of 20,000 are in view"
    );
}
