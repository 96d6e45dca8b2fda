//! What guides hold, beside what they report and what they were allowed.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use pss_guide::{Guide, fit, registry};
use serde_json::{Map, Value, json};

use crate::common::{self, options};
use crate::places::{self, sound};
use crate::world::{Paths, World};

thread_local! {
    static FREED: Cell<usize> = const { Cell::new(0) };
}

/// Counts what each thread gives back: a guide that is dropped shows how much it held, whoever had allocated it.
struct Counting;

#[allow(unsafe_code)]
// SAFETY: every call goes to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        FREED.set(FREED.get() + layout.size());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Configuration, names and the like that no report counts.
const SLACK: u64 = 8 << 10;

/// Bytes that a guide held; it is gone.
fn held(guide: Box<dyn Guide>) -> u64 {
    let before = FREED.get();
    drop(guide);
    (FREED.get() - before) as u64
}

fn memory(guide: &dyn Guide) -> u64 {
    guide.describe()["memory"].as_u64().unwrap()
}

fn fitted(name: &str, given: &Map<String, Value>, paths: &Paths) -> Box<dyn Guide> {
    fit(name, given, &paths.records(), 1, &mut |_| true)
        .unwrap()
        .guide
}

#[test]
fn what_is_reported_is_what_is_held() {
    let names = registry().iter().map(|spec| spec.name).chain(places::ALL);
    let paths = World::DEFAULT.draw(20_000, None, 1);
    for name in names {
        // One epoch is as large as many.
        let trained: Map<String, Value> = match name.split_once('+') {
            Some((net, _)) => options(&[(net, Value::from(common::epochs(net, 1)))]),
            None if name == "table" => Map::new(),
            None => common::epochs(name, 1),
        };
        let guide = fitted(name, &trained, &paths);
        let (reported, held) = (memory(&*guide), held(guide));
        let most = |x: u64| x + x / 5 + SLACK;
        assert!(
            held <= most(reported) && reported <= most(held),
            "{name}: reports {reported} bytes, held {held}"
        );
    }
}

/// What a scene does to the places of its vertices.
type Bend = fn(usize, [f32; 3]) -> [f32; 3];

/// Scenes that try a grid of cells.
const SCENES: [(&str, Bend); 6] = [
    ("usual", |_, p| p),
    ("tiny", |_, p| p.map(|x| 1e-5 * x)),
    ("huge", |_, p| p.map(|x| 1e7 * x)),
    ("a needle", |_, [x, y, z]| [1e3 * x, 1e-4 * y, 1e-4 * z]),
    // As many copies, far apart, as there are cells along an axis.
    ("instances", |i, [x, y, z]| {
        [
            x + 100.0 * (i % 64) as f32,
            y,
            z + 100.0 * (i / 64 % 64) as f32,
        ]
    }),
    // The sheets of all six normals lie in one plane.
    ("two-sided walls", |_, [x, y, _]| [x, y, 0.0]),
];

#[test]
fn memory_is_bounded_and_the_rarest_cells_give_way() {
    let usual = World::DEFAULT.draw(60_000, None, 1);
    for (scene, bend) in SCENES {
        let mut paths = usual.clone();
        for (i, c) in paths.contexts.iter_mut().enumerate() {
            c.position = bend(i, c.position);
        }
        for name in [
            "direction-table",
            "emitter-table",
            "light-table",
            "ray-table",
        ] {
            let what = format!("{name}, {scene}");
            let facts = |given| {
                let guide = fitted(name, &given, &paths);
                sound(&*guide, &what);
                let cells = guide.describe()["cells"].as_u64().unwrap();
                (held(guide), cells)
            };
            let deep = [("depth", 6.into()), ("memory_mib", 1.into())];
            let (held, cells) = facts(options(&deep));
            assert!(
                held <= (1 << 20) + SLACK && cells > 100,
                "{what}: {held} bytes, {cells} cells"
            );
            let (free, most) = facts(options(&[("depth", 6.into())]));
            // What a cell takes is planned for at its most, so that a little may be left over.
            assert!(
                most == cells || most > cells && 4 * free > 3 << 20,
                "{what}: {free} bytes, {most} cells, {cells} of them in 1 MiB"
            );
        }
    }
}

/// 256 MiB for a composite, too: a factor leaves 32 MiB for each that comes after it, and these get what it has not used.
#[test]
fn the_factors_of_a_composite_share_their_memory() {
    let paths = World::DEFAULT.draw(20_000, None, 1);
    for name in places::ALL {
        let given = match name.split_once('+') {
            Some((net, _)) => options(&[(net, Value::from(common::epochs(net, 1)))]),
            None => Map::new(),
        };
        let facts = fitted(name, &given, &paths).describe();
        let factors = facts["factors"].as_array().unwrap();
        let mut left = 256 << 20;
        for (i, factor) in factors.iter().enumerate() {
            if let Some(mib) = factor["options"]["memory_mib"].as_u64() {
                let reserved = (factors.len() - 1 - i) as u64 * (32 << 20);
                assert_eq!(mib, (left - reserved) >> 20, "{name}: {factor}");
            }
            left -= factor["memory"].as_u64().unwrap();
        }
        assert_eq!(facts["memory"], (256 << 20) - left);
    }

    // What one is told itself holds for it alone.
    let told = options(&[("light-table", json!({ "memory_mib": 1 }))]);
    let facts = fitted("table", &told, &paths).describe();
    let mib = |i: usize| {
        facts["factors"][i]["options"]["memory_mib"]
            .as_u64()
            .unwrap()
    };
    assert_eq!((mib(0), mib(2)), (160, 1));
}
