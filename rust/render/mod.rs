//! The whole path for one camera, from Gaussians to pixels and back, for callers without Python.

use crate::{
    Error,
    composite::{self, CompositeCotangents, CompositeInput, Composited, Image},
    project::{self, ProjectCotangents, ProjectOptions, Projected, Projection, Shading},
    scene::{Camera, Colors, Gaussians, Harmonics},
    simd::Real,
    tiles::{self, Tiles},
};

/// An image and what its backward pass replays.
#[derive(Debug)]
pub struct Rendered<T> {
    /// [H, W, 3]
    pub image: Vec<T>,
    /// [H, W]
    pub alphas: Vec<T>,
    /// Radii in pixels, [N, 2]; 0 where culled.
    pub radii: Vec<i32>,
    projection: Projection,
    shading: Option<Shading<T>>,
    tiles: Tiles<T>,
    composited: Composited<T>,
}

/// Gradients of all inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients<T> {
    /// [N, 3]
    pub means: Vec<T>,
    /// [N, 4]
    pub quats: Vec<T>,
    /// [N, 3]
    pub scales: Vec<T>,
    /// `[N]`
    pub opacities: Vec<T>,
    /// [N, K, 3]
    pub harmonics: Vec<T>,
    /// Row-major [4, 4]
    pub viewmat: [f64; 16],
}

/// Render Gaussians with spherical harmonics.
///
/// # Errors
/// When the arrays do not describe the same number of Gaussians, or cover too many tiles.
pub fn forward<T: Real>(
    gaussians: &Gaussians<T>,
    harmonics: &Harmonics<T>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Result<Rendered<T>, Error> {
    let Projected {
        projection,
        radii,
        colors,
        shading,
        ..
    } = project::forward(gaussians, Colors::Harmonics(harmonics), camera, options)?;
    let tiles = tiles::bin(&projection, &colors, 3, camera)?;
    let input = CompositeInput {
        projection: &projection,
        tiles: &tiles,
        camera,
        background: None,
    };
    let Image {
        image,
        alphas,
        composited,
        ..
    } = composite::forward(&input)?;
    Ok(Rendered {
        image,
        alphas,
        radii,
        projection,
        shading,
        tiles,
        composited,
    })
}

/// Gradients of a loss whose gradient with respect to the image is `v_image` [H, W, 3].
///
/// # Errors
/// When `v_image` has the wrong length.
pub fn backward<T: Real>(
    gaussians: &Gaussians<T>,
    camera: &Camera,
    options: &ProjectOptions,
    rendered: &Rendered<T>,
    v_image: &[T],
) -> Result<Gradients<T>, Error> {
    let input = CompositeInput {
        projection: &rendered.projection,
        tiles: &rendered.tiles,
        camera,
        background: None,
    };
    let v = CompositeCotangents {
        image: v_image,
        alphas: None,
    };
    let wanted = composite::Wanted {
        geometry: true,
        colors: true,
        ..composite::Wanted::default()
    };
    let composited = composite::backward(&input, &rendered.composited, &v, wanted)?;
    let cotangents = ProjectCotangents {
        means2d: Some(&composited.means2d),
        whitened: Some(&composited.whitened),
        opacities: Some(&composited.opacities),
        depths: None,
        conics: None,
        colors: Some(&composited.colors),
    };
    let wanted = project::Wanted {
        means: true,
        quats: true,
        scales: true,
        opacities: true,
        harmonics: true,
        harmonics_rest: false,
        camera: true,
    };
    let projection = &rendered.projection;
    let grads = project::backward(
        gaussians,
        rendered.shading.as_ref(),
        camera,
        options,
        projection,
        &cotangents,
        wanted,
    )?;
    Ok(Gradients {
        viewmat: grads.camera.viewmat(camera),
        means: grads.means,
        quats: grads.quats,
        scales: grads.scales,
        opacities: grads.opacities,
        harmonics: grads.harmonics,
    })
}

#[cfg(test)]
mod tests;
