//! The fused step against the formulas of torch, and what must hold exactly.

use super::*;
use crate::{at_each_level, noise};

fn step<T: Real>(
    arrays: AdamArrays<'_, T>,
    step: u64,
    options: &AdamOptions,
    selection: &Selection,
) -> Result<(), Error> {
    let (options, selection) = (*options, *selection);
    steps(vec![AdamStep {
        arrays,
        step,
        options,
        selection,
    }])
}
use hqgs::{Level, internals::simd::at_level};

/// torch's formulas, one element at a time.
macro_rules! reference {
    ($type:ty, $name:ident) => {
        fn $name(state: &mut [[$type; 3]], grad: &[$type], step: i32, o: &AdamOptions) {
            for ([p, m, v], &g) in state.iter_mut().zip(grad) {
                *m += (g - *m) * (1.0 - o.beta1) as $type;
                *v = *v * o.beta2 as $type + (1.0 - o.beta2) as $type * g * g;
                let step_size = o.lr / (1.0 - o.beta1.powf(f64::from(step)));
                let bias2_sqrt = (1.0 - o.beta2.powf(f64::from(step))).sqrt();
                *p += -step_size as $type * *m / (v.sqrt() / bias2_sqrt as $type + o.eps as $type);
            }
        }
    };
}
reference!(f32, reference_f32);
reference!(f64, reference_f64);

const OPTIONS: AdamOptions = AdamOptions {
    lr: 0.01,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-15,
};

/// In [-1, 1).
fn signed(seed: u64, n: usize) -> Vec<f64> {
    let values = noise(seed, n).into_iter();
    values.map(|v| 2.0 * v - 1.0).collect()
}

/// param, exp_avg, exp_avg_sq after `steps` steps.
fn run<T: Real>(level: Level, n: usize, steps: u64, selection: &Selection) -> [Vec<T>; 3] {
    let param = signed(1, n).into_iter().map(T::from_f64).collect();
    let mut arrays = [param, vec![T::ZERO; n], vec![T::ZERO; n]];
    for at in 1..=steps {
        let [param, exp_avg, exp_avg_sq] = &mut arrays;
        let arrays = AdamArrays {
            param,
            grad: &grad(at, n),
            exp_avg,
            exp_avg_sq,
        };
        at_level(level, || step(arrays, at, &OPTIONS, selection)).unwrap();
    }
    arrays
}

fn grad<T: Real>(at: u64, n: usize) -> Vec<T> {
    let scale = 10f64.powi(at as i32 % 5 - 3);
    signed(at + 2, n)
        .into_iter()
        .map(|v| T::from_f64(v * scale))
        .collect()
}

macro_rules! check {
    ($level:expr, $type:ty, $reference:ident, $n:expr) => {
        let got = run::<$type>($level, $n, 20, &Selection::ALL);
        let mut state: Vec<_> = signed(1, $n)
            .into_iter()
            .map(|p| [p as $type, 0.0, 0.0])
            .collect();
        for at in 1..=20 {
            $reference(&mut state, &grad(at, $n), at as i32, &OPTIONS);
        }
        for (i, expected) in state.iter().enumerate() {
            assert_eq!(
                [got[0][i], got[1][i], got[2][i]],
                *expected,
                "element {i} of {}",
                $n
            );
        }
    };
}

#[test]
fn agrees_with_the_formulas_of_torch() {
    at_each_level(|level| {
        for n in [1, 15, 16, 17, 33, 40_003] {
            check!(level, f32, reference_f32, n);
            check!(level, f64, reference_f64, n);
        }
    });
}

#[test]
fn numbers_of_a_row_that_are_not_used_are_left_alone() {
    at_each_level(check_used);
}

fn check_used(level: Level) {
    let (rows, width) = (1000, 45);
    let all = run::<f32>(level, rows * width, 3, &Selection::ALL);
    for used in [0, 9, 24, 45] {
        let some = run::<f32>(level, rows * width, 3, &Selection { width, used });
        for (i, start) in signed(1, rows * width).into_iter().enumerate() {
            let expected = if i % width < used {
                all.each_ref().map(|a| a[i])
            } else {
                [start as f32, 0.0, 0.0]
            };
            let got = some.each_ref().map(|a| a[i]);
            assert_eq!(got, expected, "{used}, element {i}");
        }
    }
}

#[test]
fn same_bits_for_any_number_of_threads() {
    let at = |level, threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| run::<f32>(level, 70_001, 3, &Selection::ALL))
            .map(|a| a.into_iter().map(f32::to_bits).collect::<Vec<_>>())
    };
    at_each_level(|level| {
        let one = at(level, 1);
        assert!(one == at(level, 2) && one == at(level, 3));
    });
}

#[test]
fn wrong_input_is_named() {
    let call = |lengths: [usize; 4], at, options: AdamOptions| {
        let [mut param, grad, mut exp_avg, mut exp_avg_sq] = lengths.map(|n| vec![1.0f32; n]);
        let arrays = AdamArrays {
            param: &mut param,
            grad: &grad,
            exp_avg: &mut exp_avg,
            exp_avg_sq: &mut exp_avg_sq,
        };
        step(arrays, at, &options, &Selection::ALL).map_err(|e| e.name().to_owned())
    };
    let named = |name: &str| Err(name.to_owned());
    assert_eq!(call([6, 5, 6, 6], 1, OPTIONS), named("grad"));
    assert_eq!(call([6, 6, 5, 6], 1, OPTIONS), named("exp_avg"));
    assert_eq!(call([6, 6, 6, 5], 1, OPTIONS), named("exp_avg_sq"));
    assert_eq!(call([0; 4], 1, OPTIONS), Ok(()));
    assert_eq!(call([6; 4], 0, OPTIONS), named("step"));
    assert_eq!(
        call(
            [6; 4],
            1,
            AdamOptions {
                lr: f64::NAN,
                ..OPTIONS
            }
        ),
        named("lr")
    );
    assert_eq!(
        call(
            [6; 4],
            1,
            AdamOptions {
                beta1: 1.0,
                ..OPTIONS
            }
        ),
        named("beta1")
    );
    assert_eq!(
        call(
            [6; 4],
            1,
            AdamOptions {
                beta2: -0.1,
                ..OPTIONS
            }
        ),
        named("beta2")
    );
    assert_eq!(
        call(
            [6; 4],
            1,
            AdamOptions {
                eps: -1.0,
                ..OPTIONS
            }
        ),
        named("eps")
    );
}
