//! The kernels on one thread, rows per second: `cargo bench -p pss-guide`. The first group is the most multiplications and
//! additions that the core does; [`guide_cost`](../examples/guide_cost/main.rs) puts the two in proportion.
#![allow(missing_docs, reason = "criterion's macros make a function")]

mod support;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use pss_guide::{Decision, fit};
use serde_json::json;
use std::hint::black_box;

use support::{BLOCK, Paths, peak, uniform, width};

fn kernels(c: &mut Criterion) {
    let mut group = c.benchmark_group("multiplications");
    group.throughput(Throughput::Elements(peak::run() as u64));
    group.bench_function(pss_guide::isa(), |b| b.iter(peak::run));
    group.finish();

    let paths = Paths::new(4096);
    let options = json!({ "epochs": 1 });
    let options = options.as_object().unwrap_or_else(|| unreachable!());
    for (name, decision) in [
        ("realnvp", Decision::Path),
        ("realnvp-logit", Decision::Path),
        ("mixture-net", Decision::Direction),
        ("spline-net", Decision::Direction),
    ] {
        let fitted = match fit(name, options, &paths.records(), 1, &mut |_| true) {
            Ok(fitted) => fitted,
            Err(error) => panic!("{name}: {error}"),
        };
        let places = paths.places(&*fitted.guide, decision);
        let numbers = uniform(BLOCK * width(decision), 1);
        let (mut block, mut q) = (numbers.clone(), vec![0.0; BLOCK]);
        let mut group = c.benchmark_group(name);
        group.throughput(Throughput::Elements(BLOCK as u64));
        group.bench_function(BenchmarkId::new("sample", BLOCK), |b| {
            b.iter(|| {
                block.copy_from_slice(&numbers);
                fitted.guide.sample(decision, places, &mut block, &mut q);
                black_box(&q);
            });
        });
        group.bench_function(BenchmarkId::new("density", BLOCK), |b| {
            b.iter(|| {
                fitted.guide.density(decision, places, &numbers, &mut q);
                black_box(&q);
            });
        });
        group.finish();
    }
}

criterion_group!(benches, kernels);
criterion_main!(benches);
