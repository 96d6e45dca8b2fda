//! Seconds per training epoch.

use std::time::Instant;

use pss_guide::{GuideError, fit, registry};
use serde_json::{Map, Value, json};

use crate::median;
use crate::support::Paths;

/// Threads that training is timed on.
const THREADS: [usize; 2] = [1, 2];

/// Epochs of one fit.
const EPOCHS: usize = 2;

/// Seconds per epoch of `rows` paths, and of a whole fit, of each guide that is wanted.
pub(crate) fn measure(
    rows: usize,
    wanted: &dyn Fn(&str) -> bool,
) -> Result<Value, Box<dyn std::error::Error>> {
    let paths = Paths::new(rows);
    let mut told = json!({ "rows": rows });
    println!(
        "\n{:16} {:>15} {:>15} {:>15} {:>8}",
        format!("epoch of {rows}"),
        "1 thread [s]",
        "its processor",
        "2 threads [s]",
        "scaling"
    );
    for spec in registry().iter().filter(|spec| wanted(spec.name)) {
        let mut options = Map::new();
        let epochs = if (spec.defaults)().contains_key("epochs") {
            options.insert("epochs".to_owned(), EPOCHS.into());
            EPOCHS
        } else {
            1 // Counted, once.
        };
        let (mut seconds, mut processor) = (THREADS.map(|_| Vec::new()), Vec::new());
        for _ in 0..3 {
            for (threads, seconds) in THREADS.into_iter().zip(&mut seconds) {
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()?;
                let epoch = pool.install(|| epoch(spec.name, &options, &paths, epochs))?;
                seconds.push(epoch.0);
                if threads == 1 {
                    processor.extend(epoch.1);
                }
            }
        }
        let [one, two] = seconds.each_ref().map(|s| median(s));
        let processor = median(&processor);
        told[spec.name] = json!({
            "1": one,
            "2": two,
            "scaling": one / two,
            "1_processor": if processor.is_nan() { Value::Null } else { processor.into() },
        });
        println!(
            "{:16} {one:>15.3} {processor:>15.3} {two:>15.3} {:>8.2}",
            spec.name,
            one / two
        );
    }
    Ok(told)
}

/// Seconds that this thread has had a processor for, where the system tells.
fn processor() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split(' ').next()?.parse::<f64>().ok()? * 1e-9)
}

/// An epoch's seconds, and those of this thread's processor. Of the steps, which a busy machine interrupts now and then, the
/// middle one times their number; of a guide that is counted the whole.
fn epoch(
    name: &str,
    options: &Map<String, Value>,
    paths: &Paths,
    epochs: usize,
) -> Result<(f64, Option<f64>), GuideError> {
    let (mut steps, mut last) = (Vec::new(), Instant::now());
    let (start, mut from, mut to) = (last, processor(), None);
    let mut tick = |_| {
        let now = Instant::now();
        steps.push((now - last).as_secs_f64());
        last = now;
        // The first tick ends the preparations, each other one a step.
        if steps.len() == 1 {
            from = processor();
        } else {
            to = processor();
        }
        true
    };
    fit(name, options, &paths.records(), 1, &mut tick)?;
    let whole = start.elapsed().as_secs_f64() / epochs as f64;
    let steps = steps.get(1..).unwrap_or_default();
    if epochs == 1 || steps.len() < 16 {
        return Ok((whole, None));
    }
    let per_epoch = (steps.len() + 1) as f64 / epochs as f64;
    let had = to
        .zip(from)
        .map(|(to, from)| (to - from) / steps.len() as f64 * per_epoch);
    Ok((median(steps) * per_epoch, had))
}
