//! The table at the end of `cargo bench`: the medians of this run beside those of the baseline. That is the run before,
//! or the one that `cargo bench -- --baseline NAME` names.

use criterion::Criterion;
use serde_json::Value;
use std::{
    env, fs,
    path::{Path, PathBuf},
    time::SystemTime,
};

/// Run benchmarks, and tell what came out.
pub fn run(settings: Criterion, benches: &[fn(&mut Criterion)]) {
    let (started, folder) = (SystemTime::now(), folder());
    let mut criterion = settings.output_directory(&folder).configure_from_args();
    benches.iter().for_each(|bench| bench(&mut criterion));
    criterion.final_summary();
    let mut rows = Vec::new();
    collect(&folder, started, &mut rows);
    if rows.is_empty() {
        return; // a list of the benchmarks, or a test that they run
    }
    println!(
        "{:<52} {:>12} {:>12} {:>7}",
        "median", "now, ms", "before, ms", "ratio"
    );
    for (name, now, change) in rows {
        let before = change.map_or_else(
            || format!("{:>12} {:>7}", "-", "-"),
            |change| format!("{:>12.3} {:>7.3}", now / (1.0 + change), 1.0 + change),
        );
        println!("{name:<52} {now:>12.3} {before}");
    }
}

/// Where criterion keeps the runs: beside what cargo built.
fn folder() -> PathBuf {
    let program = env::current_exe().expect("a program has a path");
    program
        .ancestors()
        .nth(3)
        .unwrap_or(Path::new("."))
        .join("criterion")
}

/// Name, milliseconds and change of each benchmark below `folder` that ran since `started`.
fn collect(folder: &Path, started: SystemTime, rows: &mut Vec<(String, f64, Option<f64>)>) {
    let number = |file: &str| json(&folder.join(file))?["median"]["point_estimate"].as_f64();
    let modified = fs::metadata(folder.join("new/estimates.json")).and_then(|m| m.modified());
    if modified.is_ok_and(|at| at >= started)
        && let Some(id) = json(&folder.join("new/benchmark.json"))
        && let (Some(name), Some(ns)) = (id["full_id"].as_str(), number("new/estimates.json"))
    {
        rows.push((name.into(), ns * 1e-6, number("change/estimates.json")));
        return;
    }
    let mut folders: Vec<_> = fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .collect();
    folders.sort();
    for folder in folders {
        collect(&folder, started, rows);
    }
}

fn json(path: &Path) -> Option<Value> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}
