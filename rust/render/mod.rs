//! The whole path for one camera, from Gaussians to pixels and back.

pub use crate::{composite::CompositeCotangents as Cotangents, project::RenderOptions};

use crate::{
    Error,
    composite::{self, CompositeInput, Composited, Image},
    error::check_len,
    project::{self, ProjectCotangents, Projected, Projection, Shading},
    scene::{Camera, Colors, Gaussians},
    simd::Real,
    tiles::Tiles,
};

/// An image, and what its backward pass replays: the inputs stay borrowed, so that no others can stand in.
#[derive(Debug)]
pub struct Rendered<'a, T> {
    /// [H, W, channels]
    pub image: Vec<T>,
    /// How much of each pixel the Gaussians cover, 0 to 1, [H, W].
    pub alphas: Vec<T>,
    /// Radii of the Gaussians' supports in pixels, rounded up, [N, 2]; 0 where culled.
    pub radii: Vec<i32>,
    gaussians: Gaussians<'a, T>,
    background: Option<&'a [T]>,
    camera: Camera,
    options: RenderOptions,
    projection: Projection,
    /// Whether the colours are harmonics, and how they change.
    harmonics: bool,
    shading: Option<Shading<T>>,
    tiles: Tiles<T>,
    composited: Composited<T>,
}

/// Which gradients [`backward`] is to compute: what is left out costs less, or nothing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Of the means.
    pub means: bool,
    /// Of the quaternions.
    pub quats: bool,
    /// Of the scales.
    pub scales: bool,
    /// Of the opacities.
    pub opacities: bool,
    /// Of the colours: the channels, or the harmonics.
    pub colors: bool,
    /// Of the background.
    pub background: bool,
    /// Of the camera's pose.
    pub viewmat: bool,
    /// Of the projected means, and the sums of its absolute values, by which densification decides.
    pub means2d: bool,
}

impl Wanted {
    /// Everything.
    pub const ALL: Self = Self {
        means: true,
        quats: true,
        scales: true,
        opacities: true,
        colors: true,
        background: true,
        viewmat: true,
        means2d: true,
    };

    /// Whether any of them goes through the geometry of the splats.
    fn geometry(self) -> bool {
        self.means || self.quats || self.scales || self.opacities || self.viewmat || self.means2d
    }
}

/// Gradients of the inputs; empty where not wanted or not given, 0 for a Gaussian that is culled.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gradients<T> {
    /// [N, 3]
    pub means: Vec<T>,
    /// [N, 4]
    pub quats: Vec<T>,
    /// [N, 3]
    pub scales: Vec<T>,
    /// `[N]`
    pub opacities: Vec<T>,
    /// Of the channels, [N, channels], or of `Harmonics::coefficients`, [N, K, 3].
    pub colors: Vec<T>,
    /// Of `Harmonics::rest`, [N, K - 1, 3].
    pub colors_rest: Vec<T>,
    /// `[channels]`
    pub background: Vec<T>,
    /// Of the world-to-camera matrix, row-major [4, 4]; its last row is 0.
    pub viewmat: Option<[f64; 16]>,
    /// Of the projected means in pixels, [N, 2].
    pub means2d: Vec<T>,
    /// Sums over the pixels of the absolute values of these, [N, 2].
    pub means2d_absolute: Vec<T>,
}

/// Render Gaussians in front of `background`, `[channels]` (None: 0).
///
/// # Errors
/// When the arrays do not describe the same number of Gaussians or channels, an option is out of its range, or
/// the Gaussians cover too many tiles.
pub fn forward<'a, T: Real>(
    gaussians: Gaussians<'a, T>,
    colors: Colors<'_, T>,
    background: Option<&'a [T]>,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Rendered<'a, T>, Error> {
    let channels = colors.channels();
    if let Some(background) = background {
        check_len("background", background, channels)?;
    }
    let Projected {
        projection,
        radii,
        colors: shaded,
        shading,
        ..
    } = project::forward(&gaussians, colors, camera, options, false)?;
    let (harmonics, given) = match colors {
        Colors::Harmonics(_) => (true, &shaded[..]),
        Colors::Channels(data, _) => (false, data),
    };
    let Image {
        image,
        alphas,
        tiles,
        composited,
        ..
    } = composite::forward(&projection, given, channels, camera, background)?;
    Ok(Rendered {
        image,
        alphas,
        radii,
        gaussians,
        background,
        camera: *camera,
        options: *options,
        projection,
        harmonics,
        shading,
        tiles,
        composited,
    })
}

/// Gradients of a loss, from its gradients `v` with respect to the image and the alphas.
///
/// # Errors
/// When an array of `v` has the wrong length, or harmonics were rendered with `differentiable` off.
pub fn backward<T: Real>(
    rendered: &Rendered<'_, T>,
    v: &Cotangents<T>,
    wanted: Wanted,
) -> Result<Gradients<T>, Error> {
    let input = CompositeInput {
        projection: &rendered.projection,
        tiles: &rendered.tiles,
        camera: &rendered.camera,
        background: rendered.background,
    };
    let harmonics = rendered.harmonics;
    // The colours of harmonics change with the direction in which a Gaussian is seen.
    let directed = harmonics && (wanted.means || wanted.viewmat);
    let composite_wanted = composite::Wanted {
        geometry: wanted.geometry(),
        absolute: wanted.means2d,
        colors: wanted.colors || directed,
        background: wanted.background && rendered.background.is_some(),
    };
    let splats = composite::backward(&input, &rendered.composited, v, composite_wanted)?;
    let geometry = composite_wanted.geometry;
    let cotangents = ProjectCotangents {
        means2d: geometry.then_some(&splats.means2d[..]),
        whitened: geometry.then_some(&splats.whitened[..]),
        opacities: geometry.then_some(&splats.opacities[..]),
        depths: None,
        conics: None,
        colors: (harmonics && composite_wanted.colors).then_some(&splats.colors[..]),
    };
    let project_wanted = project::Wanted {
        means: wanted.means,
        quats: wanted.quats,
        scales: wanted.scales,
        opacities: wanted.opacities,
        covars: false,
        harmonics: harmonics && wanted.colors,
        harmonics_rest: harmonics && wanted.colors,
        camera: wanted.viewmat,
    };
    let grads = project::backward(
        &rendered.gaussians,
        rendered.shading.as_ref(),
        &rendered.camera,
        &rendered.options,
        &rendered.projection,
        &cotangents,
        project_wanted,
    )?;
    let [
        means,
        quats,
        scales,
        opacities,
        _,
        of_harmonics,
        colors_rest,
    ] = grads.arrays;
    Ok(Gradients {
        viewmat: wanted
            .viewmat
            .then(|| grads.camera.viewmat(&rendered.camera)),
        means,
        quats,
        scales,
        opacities,
        colors: if wanted.colors && !harmonics {
            splats.colors
        } else {
            of_harmonics
        },
        colors_rest,
        background: splats.background,
        means2d: if wanted.means2d {
            splats.means2d
        } else {
            Vec::new()
        },
        means2d_absolute: splats.absolute,
    })
}

#[cfg(test)]
mod tests;
