use super::*;
use hqgs::internals::simd::at_level;

const SIZE: [usize; 2] = [60, 80];

/// A smooth texture without a period, of a point of the plane at depth 1.
fn texture(x: f64, y: f64) -> f32 {
    let wave =
        (7.1 * x + 3.3 * y).sin() + (5.3 * x - 8.7 * y).cos() + (13.0 * x * y + 2.0 * x).sin();
    (0.5 + wave / 8.0) as f32
}

/// The plane at depth 1 from a camera of focal length 60 at (t, 0, 0).
fn photo(t: f64) -> Vec<f32> {
    let [height, width] = SIZE;
    (0..height * width)
        .map(|k| {
            let (x, y) = ((k % width) as f64 + 0.5, (k / width) as f64 + 0.5);
            texture((x - 40.0) / 60.0 + t, (y - 30.0) / 60.0)
        })
        .collect()
}

/// From the camera at 0 to that at t: x moves by -60 t / depth.
fn map(t: f64) -> [f64; 12] {
    [1., 0., 0., -60.0 * t, 0., 1., 0., 0., 0., 0., 1., 0.]
}

fn pixels() -> Vec<[f64; 2]> {
    (0..200)
        .map(|k| {
            [
                20.5 + f64::from(k % 20) * 2.0,
                15.5 + f64::from(k / 20) * 3.0,
            ]
        })
        .collect()
}

fn swept(shifts: &[f64], range: [f64; 2], agreeing: usize) -> Vec<(f64, f32)> {
    let first = photo(0.0);
    let photos: Vec<_> = shifts.iter().map(|&t| photo(t)).collect();
    let picture = |grey| Photo { size: SIZE, grey };
    let others: Vec<_> = photos
        .iter()
        .zip(shifts)
        .map(|(grey, &t)| Other {
            picture: picture(grey),
            map: map(t),
        })
        .collect();
    let pixels = pixels();
    depths(
        picture(&first),
        &others,
        &pixels,
        &vec![range; pixels.len()],
        agreeing,
    )
    .unwrap()
}

#[test]
fn the_depth_of_the_plane_is_found() {
    for range in [[0.5, 1.1], [0.7, 1.5], [0.9, 2.0]] {
        for (depth, score) in swept(&[0.1, -0.12, 0.2], range, 2) {
            assert!(score > 0.97, "{score}");
            assert!((depth - 1.0).abs() < 0.03, "{depth}"); // 0.2 px of the closest photo
        }
    }
}

#[test]
fn where_too_few_photos_show_a_pixel_nothing_is_found() {
    assert!(
        swept(&[0.1], [0.6, 1.5], 2)
            .iter()
            .all(|&(_, score)| score < 0.6)
    ); // one of two
    assert!(
        swept(&[], [0.5, 2.0], 1)
            .iter()
            .all(|&(depth, score)| depth == 1.0 && score <= -1.0)
    );
    let away = swept(&[0.1, 5.0], [0.6, 1.5], 2); // the second looks past it
    assert!(away.iter().all(|&(_, score)| score < 0.6));
}

#[test]
fn borders_flat_patches_and_bad_input() {
    let (grey, flat) = (photo(0.0), vec![0.5; SIZE[0] * SIZE[1]]);
    let picture = Photo {
        size: SIZE,
        grey: &grey,
    };
    let other = Other {
        picture,
        map: map(0.1),
    };
    let run = |first, pixel, near| depths(first, &[other], &[pixel], &[[near, 1.5]], 1);
    assert!(run(picture, [1.0, 30.0], 1.0).unwrap()[0].1 <= -1.0);
    assert!(run(picture, [-1e30, 1e30], 1.0).unwrap()[0].1 <= -1.0);
    let flat = Photo {
        size: SIZE,
        grey: &flat,
    };
    assert!(run(flat, [40.5, 30.5], 1.0).unwrap()[0].1 <= -1.0);
    assert!(run(picture, [40.5, 30.5], 0.0).is_err());
    assert!(run(picture, [40.5, f64::NAN], 1.0).is_err());
    let behind = Other {
        picture,
        map: [-1., 0., 0., 0., 0., -1., 0., 0., 0., 0., -1., 0.],
    };
    assert!(depths(picture, &[behind], &[[40.5, 30.5]], &[[0.5, 1.5]], 1).unwrap()[0].1 <= -1.0);
    let short = Photo {
        size: SIZE,
        grey: &grey[1..],
    };
    assert!(run(short, [40.5, 30.5], 1.0).is_err());
    assert!(depths(picture, &[other], &[], &[], 0).is_err());
}

#[test]
fn each_level_and_number_of_threads_gives_the_same_bits() {
    let grey = [photo(0.0), photo(0.1), photo(-0.1)];
    let picture = |k: usize| Photo {
        size: SIZE,
        grey: &grey[k],
    };
    let others = [
        Other {
            picture: picture(1),
            map: map(0.1),
        },
        Other {
            picture: picture(2),
            map: map(-0.1),
        },
    ];
    let pixels = pixels();
    let ranges = vec![[0.7, 1.5]; pixels.len()];
    let run = |level, threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| at_level(level, || depths(picture(0), &others, &pixels, &ranges, 2)))
            .unwrap()
    };
    let all: Vec<_> = simd::levels().iter().map(|&level| run(level, 1)).collect();
    for found in &all {
        assert_eq!(*found, all[0]);
    }
    assert_eq!(run(simd::levels()[0], 3), all[0]);
}

#[test]
fn a_patch_at_the_corner_of_a_wide_picture_stays_inside() {
    // A float just below the last of so many pixels is that pixel.
    for size in [[8, 33_000], [33_000, 8], [8, 70_001]] {
        let grey: Vec<f32> = (0..size[0] * size[1])
            .map(|k| texture(k as f64 * 0.013, k as f64 * 0.007))
            .collect();
        let picture = Photo { size, grey: &grey };
        for k in 0..200 {
            let [y, x] = size.map(|side| side as f64 - 3.45 - f64::from(k) * 0.002);
            let base = [x as f32, y as f32, 1.0];
            let samples = Samples {
                base,
                across: [STRIDE, 0.0, 0.0],
                down: [0.0, STRIDE, 0.0],
            };
            if let Some(values) = samples.sampled(picture) {
                assert!(values.iter().all(|x| (0.0..=1.0).contains(x)));
            }
        }
    }
}

#[test]
fn more_pixels_than_can_be_numbered_are_refused() {
    let size = [1 << 32, 1 << 32];
    let picture = Photo { size, grey: &[] };
    let found = depths(picture, &[], &[], &[], 1);
    assert_eq!(found.unwrap_err().name(), "first");
}
