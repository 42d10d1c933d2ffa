//! Fits a few hundred Gaussians to a picture with gradients and Adam, and writes what came out as a PNG.
//!
//! ```sh
//! cargo run --release -p hqgs-training --example fit_image -- --out fit.png
//! ```

use hqgs::{
    Error,
    render::{self, Cotangents, RenderOptions, Wanted},
    scene::{Camera, Colors, Gaussians},
};
use hqgs_training::{
    adam::{self, AdamArrays, AdamOptions, AdamStep, Selection},
    loss::{self, Images, LossOptions, LossScratch},
};
use std::{fs::File, io::BufWriter};

const WIDTH: usize = 120;
const HEIGHT: usize = 80;
/// Gaussians in a row and in a column of the grid that they start from.
const GRID: [usize; 2] = [24, 16];
const ITERATIONS: u64 = 300;
const BACKGROUND: [f32; 3] = [1.0; 3];

/// The picture to fit, [H, W, 3]: a sun over striped hills.
fn target() -> Vec<f32> {
    let mut image = Vec::with_capacity(WIDTH * HEIGHT * 3);
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let (x, y) = (column as f32 / HEIGHT as f32, row as f32 / HEIGHT as f32);
            let hill = 0.62 + 0.12 * (4.0 * x).sin();
            image.extend(if y > hill {
                let stripe = if (14.0 * (y - hill) + 3.0 * x).fract() < 0.5 {
                    0.55
                } else {
                    0.35
                };
                [0.25 * stripe, stripe, 0.2]
            } else if (x - 1.0).hypot(y - 0.3) < 0.16 {
                [1.0, 0.8, 0.2]
            } else {
                [0.35 + 0.4 * y, 0.6 + 0.3 * y, 0.95]
            });
        }
    }
    image
}

/// Parameters with their learning rate and what Adam remembers.
struct Parameters {
    values: Vec<f32>,
    lr: f64,
    exp_avg: Vec<f32>,
    exp_avg_sq: Vec<f32>,
}

impl Parameters {
    fn new(values: Vec<f32>, lr: f64) -> Self {
        let zeros = vec![0.0; values.len()];
        Self {
            values,
            lr,
            exp_avg: zeros.clone(),
            exp_avg_sq: zeros,
        }
    }

    fn step<'a>(&'a mut self, grad: &'a [f32], step: u64) -> AdamStep<'a, f32> {
        AdamStep {
            arrays: AdamArrays {
                param: &mut self.values,
                grad,
                exp_avg: &mut self.exp_avg,
                exp_avg_sq: &mut self.exp_avg_sq,
            },
            step,
            options: AdamOptions::new(self.lr),
            selection: Selection::ALL,
        }
    }
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Fit the Gaussians to `target`. Returns the last picture, and the loss of each iteration.
fn fit(target: &[f32], iterations: u64) -> Result<(Vec<f32>, Vec<f64>), Error> {
    // A camera one focal length away from the plane z = 1, on which a pixel is 1 / HEIGHT wide.
    let camera = Camera::at_origin(HEIGHT as f64, WIDTH, HEIGHT)?;

    // Round, grey and half clear, on a grid; scales as logarithms and opacities as logits, which have no bounds.
    let [across, down] = GRID;
    let n = across * down;
    let spacing = 1.0 / down as f32;
    let mut means = Vec::with_capacity(3 * n);
    for i in 0..n {
        let place = |k: usize, count: usize| (k as f32 + 0.5 - count as f32 / 2.0) * spacing;
        // Not two at the same depth: their order would be arbitrary.
        let depth = 1.0 + 0.01 * (i * 37 % n) as f32 / n as f32;
        means.extend([place(i % across, across), place(i / across, down), depth]);
    }
    let mut means = Parameters::new(means, 2e-3);
    let mut quats = Parameters::new([1.0, 0.0, 0.0, 0.0].repeat(n), 2e-2);
    let mut log_scales = Parameters::new(vec![(0.5 * spacing).ln(); 3 * n], 2e-2);
    let mut logits = Parameters::new(vec![0.0; n], 5e-2);
    let mut colors = Parameters::new(vec![0.5; 3 * n], 2e-2);

    let options = RenderOptions::default();
    let wanted = Wanted {
        means: true,
        quats: true,
        scales: true,
        opacities: true,
        colors: true,
        ..Wanted::default()
    };
    let mut v_image = vec![0.0; target.len()];
    let mut scratch = LossScratch::default();
    let (mut image, mut losses) = (Vec::new(), Vec::new());
    for step in 1..=iterations {
        let scales: Vec<f32> = log_scales.values.iter().map(|x| x.exp()).collect();
        let opacities: Vec<f32> = logits.values.iter().map(|x| sigmoid(*x)).collect();
        let gaussians = Gaussians {
            means: &means.values,
            quats: &quats.values,
            scales: &scales,
            opacities: &opacities,
        };
        let channels = Colors::Channels(&colors.values, 3);
        let rendered = render::forward(gaussians, channels, Some(&BACKGROUND), &camera, &options)?;
        let images = Images {
            render: &rendered.image[..],
            target,
            mask: None,
            size: [HEIGHT, WIDTH, 3],
        };
        let value = loss::photometric(
            images,
            &LossOptions::default(),
            Some(&mut v_image),
            &mut scratch,
        )?;
        let v = Cotangents {
            image: &v_image,
            alphas: None,
        };
        let mut gradients = render::backward(&rendered, &v, wanted)?;
        image = rendered.image;
        losses.push(value.loss);
        if step % 50 == 0 || step == 1 {
            println!("step {step:4}  loss {:.4}", value.loss);
        }
        // The chain rule through the exponential and the sigmoid.
        for (g, scale) in gradients.scales.iter_mut().zip(&scales) {
            *g *= scale;
        }
        for (g, opacity) in gradients.opacities.iter_mut().zip(&opacities) {
            *g *= opacity * (1.0 - opacity);
        }
        adam::steps(vec![
            means.step(&gradients.means, step),
            quats.step(&gradients.quats, step),
            log_scales.step(&gradients.scales, step),
            logits.step(&gradients.opacities, step),
            colors.step(&gradients.colors, step),
        ])?;
    }
    Ok((image, losses))
}

/// Write pictures of the same size side by side.
fn write_png(path: &str, pictures: [&[f32]; 2]) -> Result<(), Box<dyn std::error::Error>> {
    let width = pictures.len() * WIDTH;
    let mut encoder = png::Encoder::new(
        BufWriter::new(File::create(path)?),
        u32::try_from(width)?,
        u32::try_from(HEIGHT)?,
    );
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let rows = (0..HEIGHT).flat_map(|y| pictures.map(|p| &p[y * WIDTH * 3..(y + 1) * WIDTH * 3]));
    let bytes: Vec<u8> = rows
        .flatten()
        .map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&bytes)?;
    Ok(writer.finish()?)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let path = match (arguments.next().as_deref(), arguments.next()) {
        (None, _) => "fit_image.png".to_owned(),
        (Some("--out"), Some(path)) => path,
        _ => return Err("usage: fit_image [--out FILE.png]".into()),
    };
    let target = target();
    let (image, losses) = fit(&target, ITERATIONS)?;
    let last = losses.last().ok_or("there was no iteration")?;
    println!(
        "{} Gaussians, loss {:.4} to {last:.4}",
        GRID[0] * GRID[1],
        losses[0]
    );
    write_png(&path, [&target, &image])?;
    println!("{path}: the picture, and beside it the Gaussians");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loss_falls_to_a_fifth() {
        let (_, losses) = fit(&target(), 100).unwrap();
        assert!(
            losses[99] < 0.2 * losses[0],
            "{} to {}",
            losses[0],
            losses[99]
        );
    }
}
