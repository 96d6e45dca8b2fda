//! What guides cost: µs per sample with its density and per density on one thread, beside candle and beside the most
//! multiplications and additions that the core does; seconds per training epoch on one thread and on two.
//!
//! `cargo run --release -p pss-guide --example guide_cost -- [--json FILE] [--rounds N] [--rows N] [--only COST|TRAINING] [NAME…]`
//!
//! Everything takes turns in slices of about a millisecond, shorter than what a busy machine gives a thread at a time;
//! medians over the rounds are told, and shares of the peak that ran in the same round. An epoch is the median of its steps
//! times their number.
#![allow(clippy::print_stdout, reason = "a table is what this program is for")]

#[path = "../../benches/support/mod.rs"]
mod support;
mod training;

use std::hint::black_box;
use std::time::Instant;

use candle_core::Tensor;
use pss_guide::{Context, Decision, Guide, fit, registry};
use serde_json::{Map, Value, json};

use support::candle::{Flow, matrix};
use support::{BLOCK, DIMS, Paths, multiplications, peak, uniform, width};

/// candle is timed with its usual user's allocator: the system's costs it another third.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Seconds of a slice, at least.
const SLICE: f64 = 1e-3;

/// Rows per call of candle's tensors; the fastest is told.
const CANDLE_ROWS: [usize; 3] = [256, 1024, 4096];

/// Paths that guides are fitted to before they are timed.
const LEARNED: usize = 8192;

type Failure = Box<dyn std::error::Error>;

/// What the command line asks for.
struct Wanted {
    json: Option<String>,
    rounds: usize,
    rows: usize,
    only: Option<String>,
    names: Vec<String>,
}

impl Wanted {
    fn parse() -> Result<Self, Failure> {
        let mut wanted = Self {
            json: None,
            rounds: 31,
            rows: 100_000,
            only: None,
            names: Vec::new(),
        };
        let mut given = std::env::args().skip(1);
        while let Some(argument) = given.next() {
            let mut value = || given.next().ok_or(format!("{argument} lacks its value"));
            match &*argument {
                "--json" => wanted.json = Some(value()?),
                "--rounds" => wanted.rounds = value()?.parse::<usize>()?.max(1),
                "--rows" => wanted.rows = value()?.parse::<usize>()?.max(1024),
                "--only" => wanted.only = Some(value()?),
                _ => wanted.names.push(argument),
            }
        }
        Ok(wanted)
    }
}

fn main() -> Result<(), Failure> {
    let wanted = Wanted::parse()?;
    let asked = |what: &str| wanted.only.as_deref().is_none_or(|only| only == what);
    let before = load();
    let mut told = json!({ "isa": pss_guide::isa(), "rounds": wanted.rounds });
    if asked("cost") {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
        let (peak, guides) = pool.install(|| costs(&wanted).map_err(|e| e.to_string()))?;
        told["peak"] = peak;
        told["guides"] = guides;
    }
    if asked("training") {
        told["training"] = training::measure(wanted.rows, &|name| named(&wanted, name))?;
    }
    told["load_average"] = json!({ "before": before, "after": load() });
    println!("load average {before} before, {} after", load());
    if let Some(path) = wanted.json {
        std::fs::write(path, serde_json::to_string_pretty(&told)?)?;
    }
    Ok(())
}

fn named(wanted: &Wanted, name: &str) -> bool {
    wanted.names.is_empty() || wanted.names.iter().any(|n| n == name)
}

/// Mean number of processes that wanted the processor in the last minute; null where the system does not tell.
fn load() -> Value {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let first = text.split(' ').next().unwrap_or_default();
    first.parse::<f64>().map_or(Value::Null, Value::from)
}

/// Something that is timed, and what it does per call.
struct Contestant<'a> {
    guide: &'static str,
    what: &'static str,
    rows: usize,
    run: Box<dyn FnMut() -> Result<(), Failure> + 'a>,
    /// Calls that make a slice.
    calls: usize,
    /// µs per row of every round.
    times: Vec<f64>,
}

impl<'a> Contestant<'a> {
    fn new(
        guide: &'static str,
        what: &'static str,
        rows: usize,
        run: impl FnMut() -> Result<(), Failure> + 'a,
    ) -> Self {
        Self {
            guide,
            what,
            rows,
            run: Box::new(run),
            calls: 1,
            times: Vec::new(),
        }
    }

    /// Warms up and finds how many calls make a slice.
    fn prepare(&mut self) -> Result<(), Failure> {
        let mut least = f64::INFINITY;
        for _ in 0..5 {
            let start = Instant::now();
            (self.run)()?;
            least = least.min(start.elapsed().as_secs_f64());
        }
        self.calls = (SLICE / least).ceil().clamp(1.0, 1e6) as usize;
        Ok(())
    }

    fn measure(&mut self) -> Result<(), Failure> {
        let start = Instant::now();
        for _ in 0..self.calls {
            (self.run)()?;
        }
        let micros = start.elapsed().as_secs_f64() * 1e6;
        self.times.push(micros / (self.calls * self.rows) as f64);
        Ok(())
    }
}

/// The middle one.
pub(crate) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The peak of one core, and what each guide takes of it.
fn costs(wanted: &Wanted) -> Result<(Value, Value), Failure> {
    let paths = Paths::new(LEARNED);
    let mut fitted = Vec::new();
    for spec in registry().iter().filter(|s| named(wanted, s.name)) {
        let mut options = Map::new();
        if (spec.defaults)().contains_key("epochs") {
            options.insert("epochs".to_owned(), 1.into());
        }
        let fit = fit(spec.name, &options, &paths.records(), 1, &mut |_| true)?;
        fitted.push((spec.name, spec.models[0], spec.cost_ratio, fit.guide));
    }
    let mut contestants = vec![Contestant::new("", "peak", 1, || {
        black_box(peak::run());
        Ok(())
    })];
    for (name, decision, _, guide) in &fitted {
        let places = paths.places(&**guide, *decision);
        contestants.extend(fused(name, *decision, &**guide, places));
        if *decision == Decision::Path && name.starts_with("realnvp") {
            contestants.extend(candle(name, &**guide)?);
        }
    }
    for contestant in &mut contestants {
        contestant.prepare()?;
    }
    for _ in 0..wanted.rounds {
        for contestant in &mut contestants {
            contestant.measure()?;
        }
    }
    let (peak, rest) = contestants.split_first().ok_or("nothing to measure")?;
    // Multiplications per µs of each round.
    let rates: Vec<f64> = peak.times.iter().map(|t| peak::run() as f64 / t).collect();
    println!(
        "{}, peak of a core {:.1} GFLOP/s\n\n{:16} {:>10} {:>12} {:>13} {:>12} {:>12} {:>7}",
        pss_guide::isa(),
        2e-3 * median(&rates),
        "guide",
        "parameters",
        "sample [µs]",
        "density [µs]",
        "of the peak",
        "candle [µs]",
        "÷ fused"
    );
    let mut guides = Map::new();
    for (name, _, cost_ratio, guide) in &fitted {
        let mine: Vec<_> = rest.iter().filter(|c| c.guide == *name).collect();
        guides.insert(
            (*name).to_owned(),
            describe(name, &**guide, *cost_ratio, &mine, &rates),
        );
    }
    let peak =
        json!({ "gflops_per_core": 2e-3 * median(&rates), "instructions": pss_guide::isa() });
    Ok((peak, Value::Object(guides)))
}

/// One guide's row, printed, too.
fn describe(
    name: &str,
    guide: &dyn Guide,
    cost_ratio: f64,
    mine: &[&Contestant<'_>],
    rates: &[f64],
) -> Value {
    let best = |what: &str| {
        let times = mine.iter().filter(|c| c.what == what).map(|c| &c.times);
        times.min_by(|a, b| median(a).total_cmp(&median(b)))
    };
    let products = multiplications(guide);
    let mut row = json!({
        "parameters": guide.parameters(),
        "multiplications": products,
        "cost_ratio_of_the_registry": cost_ratio,
    });
    let mut ratios = Vec::new();
    for what in ["sample", "density"] {
        let Some(times) = best(what) else { continue };
        row[format!("{what}_us")] = median(times).into();
        if let Some(products) = products {
            let shares = times
                .iter()
                .zip(rates)
                .map(|(t, r)| products as f64 / t / r);
            let shares: Vec<f64> = shares.collect();
            row[format!("{what}_share_of_peak")] = median(&shares).into();
        }
        if let Some(candle) = best(&format!("candle {what}")) {
            let over: Vec<f64> = candle.iter().zip(times).map(|(c, t)| c / t).collect();
            row[format!("candle_{what}_us")] = median(candle).into();
            row[format!("candle_{what}_over_fused")] = median(&over).into();
            ratios.push(median(&over));
        }
    }
    let number = |key: &str, digits: usize| {
        let value = row[key].as_f64();
        value.map_or(String::new(), |v| format!("{v:.digits$}"))
    };
    let share = row["sample_share_of_peak"].as_f64();
    println!(
        "{name:16} {:>10} {:>12} {:>13} {:>12} {:>12} {:>7}",
        guide.parameters(),
        number("sample_us", 3),
        number("density_us", 3),
        share.map_or(String::new(), |s| format!("{:.0} %", 100.0 * s)),
        number("candle_sample_us", 2),
        number("candle_sample_over_fused", 1),
    );
    row
}

/// The guide as the renderer asks it.
fn fused<'a>(
    name: &'static str,
    decision: Decision,
    guide: &'a dyn Guide,
    places: &'a [Context],
) -> [Contestant<'a>; 2] {
    let numbers = uniform(BLOCK * width(decision), 1);
    let (mut block, mut q) = (numbers.clone(), vec![0.0; BLOCK]);
    let mut densities = vec![0.0; BLOCK];
    let given = numbers.clone();
    [
        Contestant::new(name, "sample", BLOCK, move || {
            block.copy_from_slice(&numbers);
            guide.sample(decision, places, &mut block, &mut q);
            black_box(&q);
            Ok(())
        }),
        Contestant::new(name, "density", BLOCK, move || {
            guide.density(decision, places, &given, &mut densities);
            black_box(&densities);
            Ok(())
        }),
    ]
}

/// The same flow by candle's operations: the networks alone, without base numbers and logit, in candle's favour.
fn candle<'a>(name: &'static str, guide: &dyn Guide) -> Result<Vec<Contestant<'a>>, Failure> {
    let mut contestants = Vec::new();
    for rows in CANDLE_ROWS {
        for (what, generate) in [("candle sample", true), ("candle density", false)] {
            let flow = Flow::of(guide)?;
            let x: Tensor = matrix(&uniform(rows * DIMS, 3), DIMS)?;
            contestants.push(Contestant::new(name, what, rows, move || {
                let (x, log_det) = flow.run(&x, generate)?;
                black_box((x.to_vec2::<f32>()?, log_det.to_vec1::<f32>()?));
                Ok(())
            }));
        }
    }
    Ok(contestants)
}
