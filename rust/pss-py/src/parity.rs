//! Values of single plugins, for tests against one Mitsuba call.

use std::sync::LazyLock;

use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pss_render::Interaction;
use pss_render::bsdf::{BsdfSample, Materials, ShadingPoint};
use pss_render::math::{Frame, Rgb, Vec2, Vec3};
use pss_render::texture::TexturePoint;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::scene::Scene;
use crate::{arrays, errors};

/// Local directions or points.
fn vectors(a: &PyReadonlyArray2<'_, f32>, name: &str) -> PyResult<Vec<Vec3>> {
    Ok(arrays::rows::<3>(a, name)?
        .into_iter()
        .map(Vec3::from_array)
        .collect())
}

fn index(what: &str, i: usize, count: usize) -> PyResult<usize> {
    if i < count {
        Ok(i)
    } else {
        Err(errors::value(format!(
            "{what} {i} does not exist (there are {count})"
        )))
    }
}

/// (wo, weight, pdf, delta)
type Samples = (Py<PyAny>, Py<PyAny>, Py<PyAny>, Py<PyAny>);

fn samples(py: Python<'_>, drawn: Vec<Option<BsdfSample>>) -> PyResult<Samples> {
    let nothing = BsdfSample {
        wo: Vec3::ZERO,
        weight: Rgb::ZERO,
        pdf: 0.0,
        delta: false,
    };
    let drawn: Vec<_> = drawn.into_iter().map(|s| s.unwrap_or(nothing)).collect();
    let wo: Vec<Vec3> = drawn.iter().map(|s| s.wo).collect();
    let weight: Vec<Rgb> = drawn.iter().map(|s| s.weight).collect();
    Ok((
        arrays::to_rows3(py, &wo)?,
        arrays::to_rows3(py, &weight)?,
        arrays::to_vector::<f32>(py, drawn.iter().map(|s| s.pdf).collect()),
        arrays::to_vector::<bool>(py, drawn.iter().map(|s| s.delta).collect()),
    ))
}

/// The surface that BSDFs are called on: local and world space are one, and ∂p/∂v leans towards ∂p/∂u.
static SURFACE: LazyLock<(Interaction, Frame)> = LazyLock::new(|| {
    let si = Interaction {
        n: Vec3::Z,
        shading_normal: Vec3::Z,
        dp_du: Vec3::new(2.0, 0.0, 0.0),
        dp_dv: Vec3::new(0.5, 1.5, 0.0),
        ..Interaction::default()
    };
    (si, si.uv_frame())
});

fn at(materials: &Materials, uv: [f32; 2]) -> ShadingPoint<'_> {
    ShadingPoint {
        uv: uv.into(),
        mesh: pss_render::MeshPoint::NOWHERE,
        materials,
        surface: Some((&SURFACE.0, &SURFACE.1)),
    }
}

#[pymethods]
impl Scene {
    /// The surface that each ray meets.
    fn ray_intersect<'py>(
        &self,
        py: Python<'py>,
        origins: PyReadonlyArray2<'py, f32>,
        directions: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let origins = arrays::rows::<3>(&origins, "origins")?;
        let directions = arrays::rows::<3>(&directions, "directions")?;
        arrays::same_rows("directions", directions.len(), origins.len())?;
        let hits: Vec<_> = py.detach(|| {
            let rays = origins
                .iter()
                .zip(&directions)
                .map(|(o, d)| embree4::Ray::new(*o, *d));
            rays.map(|ray| self.inner.intersect(&ray)).collect()
        });
        let column = |get: &dyn Fn(&pss_render::Interaction) -> Vec3| -> PyResult<Py<PyAny>> {
            let rows: Vec<Vec3> = hits
                .iter()
                .map(|h| h.as_ref().map_or(Vec3::ZERO, get))
                .collect();
            arrays::to_rows3(py, &rows)
        };
        let dict = PyDict::new(py);
        let valid = hits.iter().map(Option::is_some).collect();
        dict.set_item("valid", arrays::to_vector::<bool>(py, valid))?;
        dict.set_item("p", column(&|si| si.p)?)?;
        dict.set_item("n", column(&|si| si.n)?)?;
        dict.set_item("sh_n", column(&|si| si.shading_normal)?)?;
        dict.set_item("sh_s", column(&|si| si.uv_frame().s)?)?;
        dict.set_item("dp_dv", column(&|si| si.dp_dv)?)?;
        let uv: Vec<[f32; 2]> = hits
            .iter()
            .map(|h| h.as_ref().map_or([0.0; 2], |si| si.uv.to_array()))
            .collect();
        dict.set_item("uv", arrays::to_rows2(py, &uv)?)?;
        let shape = hits
            .iter()
            .map(|h| h.as_ref().map_or(u32::MAX, |si| si.shape))
            .collect();
        dict.set_item("shape", arrays::to_vector::<u32>(py, shape))?;
        Ok(dict)
    }

    /// f·|cos θ_o| and density for local directions.
    fn bsdf_eval_pdf(
        &self,
        py: Python<'_>,
        bsdf: usize,
        uv: PyReadonlyArray2<'_, f32>,
        wi: PyReadonlyArray2<'_, f32>,
        wo: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let materials = self.inner.materials();
        let bsdf = materials.bsdf(index("bsdf", bsdf, materials.bsdfs())?);
        let uv = arrays::rows::<2>(&uv, "uv")?;
        let (wi, wo) = (vectors(&wi, "wi")?, vectors(&wo, "wo")?);
        arrays::same_rows("wi", wi.len(), uv.len())?;
        arrays::same_rows("wo", wo.len(), uv.len())?;
        let (values, pdfs): (Vec<Rgb>, Vec<f32>) = (0..uv.len())
            .map(|i| bsdf.eval_pdf(at(materials, uv[i]), wi[i], wo[i]))
            .unzip();
        Ok((arrays::to_rows3(py, &values)?, arrays::to_vector(py, pdfs)))
    }

    /// Directions drawn from a BSDF: (wo, weight, pdf, delta), pdf 0 where the path ends.
    fn bsdf_sample(
        &self,
        py: Python<'_>,
        bsdf: usize,
        uv: PyReadonlyArray2<'_, f32>,
        wi: PyReadonlyArray2<'_, f32>,
        u: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<Samples> {
        let materials = self.inner.materials();
        let bsdf = materials.bsdf(index("bsdf", bsdf, materials.bsdfs())?);
        let (uv, u) = (arrays::rows::<2>(&uv, "uv")?, arrays::rows::<2>(&u, "u")?);
        let wi = vectors(&wi, "wi")?;
        arrays::same_rows("wi", wi.len(), uv.len())?;
        arrays::same_rows("u", u.len(), uv.len())?;
        let drawn = (0..uv.len()).map(|i| bsdf.sample(at(materials, uv[i]), wi[i], u[i]));
        samples(py, drawn.collect())
    }

    /// A BSDF's delta lobes alone: their probability, and what `sample` gives of those drawn among them.
    fn bsdf_sample_delta(
        &self,
        py: Python<'_>,
        bsdf: usize,
        uv: PyReadonlyArray2<'_, f32>,
        wi: PyReadonlyArray2<'_, f32>,
        u: PyReadonlyArray1<'_, f32>,
    ) -> PyResult<(Py<PyAny>, Samples)> {
        let materials = self.inner.materials();
        let bsdf = materials.bsdf(index("bsdf", bsdf, materials.bsdfs())?);
        let (uv, wi) = (arrays::rows::<2>(&uv, "uv")?, vectors(&wi, "wi")?);
        let u = arrays::vector(&u);
        arrays::same_rows("wi", wi.len(), uv.len())?;
        arrays::same_rows("u", u.len(), uv.len())?;
        let points = || uv.iter().map(|uv| at(materials, *uv)).zip(&wi);
        let probability = points().map(|(at, wi)| bsdf.delta_probability(at, *wi));
        let drawn = points()
            .zip(&u)
            .map(|((at, wi), u)| bsdf.sample_delta(at, *wi, *u));
        let probability = arrays::to_vector::<f32>(py, probability.collect());
        Ok((probability, samples(py, drawn.collect())?))
    }

    /// A texture's colours.
    fn texture_eval(
        &self,
        py: Python<'_>,
        texture: usize,
        uv: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<Py<PyAny>> {
        let materials = self.inner.materials();
        let texture = materials.texture(index("texture", texture, materials.textures())?);
        let rows = arrays::rows::<2>(&uv, "uv")?;
        let values: Vec<Rgb> = rows
            .into_iter()
            .map(|uv| texture.eval(Vec2::from(uv).into()))
            .collect();
        arrays::to_rows3(py, &values)
    }

    /// A texture's colours (n, 3) and scalars (n,) where rays meet surfaces; zero where they meet none.
    fn texture_eval_at_hits(
        &self,
        py: Python<'_>,
        texture: usize,
        origins: PyReadonlyArray2<'_, f32>,
        directions: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let materials = self.inner.materials();
        let texture = materials.texture(index("texture", texture, materials.textures())?);
        let origins = arrays::rows::<3>(&origins, "origins")?;
        let directions = arrays::rows::<3>(&directions, "directions")?;
        arrays::same_rows("directions", directions.len(), origins.len())?;
        let (colours, scalars): (Vec<Rgb>, Vec<f32>) = origins
            .iter()
            .zip(&directions)
            .map(|(o, d)| {
                let Some(si) = self.inner.intersect(&embree4::Ray::new(*o, *d)) else {
                    return (Rgb::ZERO, 0.0);
                };
                let mesh = Some((si.mesh_point(), materials.attributes()));
                let at = TexturePoint { uv: si.uv, mesh };
                (texture.eval(at), texture.eval_scalar(at))
            })
            .unzip();
        Ok((
            arrays::to_rows3(py, &colours)?,
            arrays::to_vector(py, scalars),
        ))
    }

    /// Light drawn from an emitter towards reference points.
    fn emitter_sample<'py>(
        &self,
        py: Python<'py>,
        emitter: usize,
        reference: PyReadonlyArray2<'py, f32>,
        u: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let emitter = index("emitter", emitter, self.inner.emitters().len())?;
        let (reference, u) = (
            vectors(&reference, "reference")?,
            arrays::rows::<2>(&u, "u")?,
        );
        arrays::same_rows("u", u.len(), reference.len())?;
        let samples: Vec<_> = reference
            .iter()
            .zip(&u)
            .map(|(p, u)| self.inner.sample_emitter(emitter, *p, *u))
            .collect();
        let column = |get: &dyn Fn(&pss_render::emitter::EmitterSample) -> Vec3| {
            let rows: Vec<Vec3> = samples
                .iter()
                .map(|s| s.as_ref().map_or(Vec3::ZERO, get))
                .collect();
            arrays::to_rows3(py, &rows)
        };
        let dict = PyDict::new(py);
        dict.set_item("d", column(&|s| s.d)?)?;
        dict.set_item("radiance", column(&|s| s.radiance)?)?;
        dict.set_item("p", column(&|s| s.target.unwrap_or(Vec3::ZERO))?)?;
        let pdf = samples
            .iter()
            .map(|s| s.as_ref().map_or(0.0, |s| s.pdf))
            .collect();
        dict.set_item("pdf", arrays::to_vector::<f32>(py, pdf))?;
        Ok(dict)
    }

    /// What rays see of an emitter, and its density at each: the surface that they meet, where it is one.
    fn emitter_eval_pdf(
        &self,
        py: Python<'_>,
        emitter: usize,
        reference: PyReadonlyArray2<'_, f32>,
        directions: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let emitter = index("emitter", emitter, self.inner.emitters().len())?;
        let reference = arrays::rows::<3>(&reference, "reference")?;
        let directions = arrays::rows::<3>(&directions, "directions")?;
        arrays::same_rows("directions", directions.len(), reference.len())?;
        let (values, pdfs): (Vec<Rgb>, Vec<f32>) = reference
            .iter()
            .zip(&directions)
            .map(|(p, d)| self.inner.eval_emitter(emitter, *p, *d))
            .unzip();
        Ok((arrays::to_rows3(py, &values)?, arrays::to_vector(py, pdfs)))
    }

    /// Camera rays through film positions and points of the lens, its centre by default: (origins, directions).
    #[pyo3(signature = (pixels, lens=None))]
    fn film_ray(
        &self,
        py: Python<'_>,
        pixels: PyReadonlyArray2<'_, f32>,
        lens: Option<PyReadonlyArray2<'_, f32>>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let pixels = arrays::rows::<2>(&pixels, "pixels")?;
        let lens = match lens {
            Some(lens) => arrays::rows::<2>(&lens, "lens")?,
            None => vec![[0.5; 2]; pixels.len()],
        };
        arrays::same_rows("lens", lens.len(), pixels.len())?;
        let rays: Vec<_> = pixels
            .into_iter()
            .zip(lens)
            .map(|(p, lens)| self.inner.sensor().ray(p, lens))
            .collect();
        let origins: Vec<Vec3> = rays.iter().map(|r| Vec3::from_array(r.origin)).collect();
        let directions: Vec<Vec3> = rays.iter().map(|r| Vec3::from_array(r.dir)).collect();
        Ok((
            arrays::to_rows3(py, &origins)?,
            arrays::to_rows3(py, &directions)?,
        ))
    }
}
