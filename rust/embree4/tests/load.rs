//! Finding the library. Each case needs a process of its own, for the library is loaded once and its
//! environment is read then: the test binary runs itself with another environment.
#![allow(clippy::unwrap_used)]

mod common;

use std::process::Command;

/// What the child prints before its one line of answer.
const MARK: &str = "answer: ";

/// The child's half: tries to make a device and says how it went. Does nothing in an ordinary run.
#[test]
#[allow(clippy::print_stdout)]
fn child() {
    let Ok(how) = std::env::var("EMBREE4_TEST_CHILD") else {
        return;
    };
    let candidates = if how == "candidates" {
        common::candidates()
    } else {
        Vec::new()
    };
    if how == "search_dirs" {
        embree4::add_search_dirs(&common::candidates());
    }
    let answer = match embree4::Device::with_candidates(&candidates) {
        Ok(device) => format!("{device:?}"),
        Err(error) => error.to_string(),
    };
    println!("\n{MARK}{}", answer.replace('\n', "\\n"));
}

fn answer(how: &str, environment: &[(&str, &str)]) -> String {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "child", "--nocapture"])
        .env("EMBREE4_TEST_CHILD", how);
    for name in ["EMBREE4_LIBRARY", "PSSFLOW_EMBREE_DIRS", "PSSFLOW_ISA"] {
        command.env_remove(name);
    }
    let output = command.envs(environment.iter().copied()).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines()
        .find_map(|line| line.strip_prefix(MARK))
        .unwrap()
        .to_owned()
}

/// Directories that hold the library, as one variable; empty where the tests lean on the system's.
fn dirs() -> String {
    match std::env::var("PSSFLOW_EMBREE_DIRS") {
        Ok(dirs) => dirs,
        Err(_) => std::env::join_paths(common::candidates())
            .unwrap()
            .into_string()
            .unwrap(),
    }
}

#[test]
fn a_library_that_is_not_embree() {
    let text = answer(
        "plain",
        &[
            ("EMBREE4_LIBRARY", "libc.so.6"),
            ("PSSFLOW_EMBREE_DIRS", &dirs()),
        ],
    );
    assert_eq!(
        text,
        "no usable Embree 4 library found. Looked at: EMBREE4_LIBRARY is set, so nowhere else; libc.so.6 (not an \
         Embree 4 library: it has no function rtcNewDevice). Install one with `pip install embreex` or \
         `apt install libembree4-4`, or set EMBREE4_LIBRARY to the file"
    );
}

#[test]
fn a_library_that_does_not_exist() {
    let text = answer("plain", &[("EMBREE4_LIBRARY", "/nowhere/libembree4.so")]);
    assert!(
        text.contains("; /nowhere/libembree4.so (") && text.contains("No such file"),
        "{text}"
    );
    assert!(
        text.contains("pip install embreex") && !text.contains("\\n"),
        "{text}"
    );
}

#[test]
fn every_place_is_named_when_none_has_it() {
    let empty = concat!(env!("CARGO_MANIFEST_DIR"), "/src");
    let text = answer("plain", &[("PSSFLOW_EMBREE_DIRS", empty)]);
    // A machine with Embree installed finds it before it comes to that.
    if !text.starts_with("Device(Embree 4.") {
        for place in [
            "libembree4.so.4 (",
            "libembree4.so (",
            empty,
            "embreex.libs/",
            "apt install libembree4-4",
        ] {
            assert!(text.contains(place), "{text} does not name {place}");
        }
    }
}

#[test]
fn each_way_to_name_a_directory_works() {
    let dirs = dirs();
    for (how, environment) in [
        ("plain", vec![("PSSFLOW_EMBREE_DIRS", dirs.as_str())]),
        ("candidates", vec![]),
        ("search_dirs", vec![]),
        ("candidates", vec![("EMBREE4_LIBRARY", "")]),
    ] {
        let text = answer(how, &environment);
        assert!(
            text.starts_with("Device(Embree 4."),
            "{how} {environment:?}: {text}"
        );
    }
}

#[test]
fn the_instruction_set_is_checked() {
    let text = answer("candidates", &[("PSSFLOW_ISA", "mmx")]);
    assert!(
        text.starts_with("PSSFLOW_ISA = \"mmx\" is not an instruction set"),
        "{text}"
    );
    for isa in ["sse4.2", "avx2", "avx512"] {
        let text = answer("candidates", &[("PSSFLOW_ISA", isa)]);
        let lacking = format!("instruction set {isa} was asked for, but this processor lacks it");
        assert!(
            text.starts_with("Device(Embree 4.") || text.starts_with(&lacking),
            "{text}"
        );
    }
}
