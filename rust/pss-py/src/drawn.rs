//! Paths that were drawn, with what each decision came to, as Python gets them.

use pss_render::Paths;
use pss_render::steps::Steps;
use pssflow::Mixture;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays;
use crate::scene::traced;

/// What `trace` returns, film positions, steps, and the densities m of both terms.
pub(crate) fn to_dict<'py>(
    py: Python<'py>,
    blocks: &[Paths],
    mixture: Mixture,
    k: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let dict = traced(py, blocks, k)?;
    let film: Vec<[f32; 2]> = blocks.iter().flat_map(|b| b.film.iter().copied()).collect();
    dict.set_item("film", arrays::to_rows2(py, &film)?)?;
    let lens: Vec<[f32; 2]> = blocks.iter().flat_map(|b| b.lens.iter().copied()).collect();
    dict.set_item("lens", arrays::to_rows2(py, &lens)?)?;
    for (name, get) in [
        ("m_nee", (|b| &b.q_nee) as fn(&Paths) -> &Vec<f32>),
        ("m_bsdf", |b| &b.q_bsdf),
    ] {
        let m = blocks
            .iter()
            .flat_map(|b| get(b).iter().map(|&q| mixture.density(q)))
            .collect();
        dict.set_item(name, arrays::to_vector::<f32>(py, m))?;
    }
    let steps = || blocks.iter().filter_map(|b| b.steps.as_ref());
    let scattered = || steps().flat_map(|s| &s.scattered);
    let cube = |get: &dyn Fn(&pss_render::steps::Step) -> [f32; 3]| {
        arrays::to_cube(py, scattered().flat_map(get).collect(), [film.len(), k, 3])
    };
    dict.set_item("step_d", cube(&|s| s.d)?)?;
    dict.set_item("step_weight", cube(&|s| s.weight)?)?;
    let pdf = scattered().map(|s| s.pdf).collect();
    dict.set_item("step_pdf", arrays::to_matrix(py, pdf, k)?)?;
    let joins = |s: &Steps| s.joins.clone();
    let d: Vec<f32> = steps().flat_map(joins).flat_map(|j| j.d).collect();
    dict.set_item("join_d", arrays::to_matrix(py, d, 3)?)?;
    let scale = steps().flat_map(joins).map(|j| j.scale).collect();
    dict.set_item("join_scale", arrays::to_vector::<f32>(py, scale))?;
    let mis = steps().flat_map(|s| s.mis.iter().copied()).collect();
    dict.set_item("mis", arrays::to_vector::<f32>(py, mis))?;
    Ok(dict)
}

/// What guides learn from beside that: all numbers, and the density of all of them together.
pub(crate) fn set_numbers(
    py: Python<'_>,
    dict: &Bound<'_, PyDict>,
    blocks: &[Paths],
    mixture: Mixture,
    width: usize,
) -> PyResult<()> {
    let u = blocks.iter().flat_map(|b| b.u.iter().copied()).collect();
    dict.set_item("u", arrays::to_matrix(py, u, width)?)?;
    let both =
        |b: &Paths| -> Vec<f32> { b.q_nee.iter().zip(&b.q_ray).map(|(a, b)| a * b).collect() };
    let m = blocks
        .iter()
        .flat_map(both)
        .map(|q| mixture.density(q))
        .collect();
    dict.set_item("m_both", arrays::to_vector::<f32>(py, m))
}
