//! Which vector instructions are used: the best that the CPU has, or those that `HQGS_SIMD` names.

use crate::error::Error;
use std::{cell::Cell, fmt, sync::OnceLock};

/// The environment variable that forces a level.
const VARIABLE: &str = "HQGS_SIMD";

/// Every level: how the variable names it, and its own name.
const NAMES: [(&str, &str); 6] = [
    ("avx512", "AVX-512"),
    ("avx2", "AVX2"),
    ("sse4.2", "SSE4.2"),
    ("sse2", "SSE2"),
    ("neon", "NEON"),
    ("scalar", "none"),
];

/// Vector instructions that this CPU has.
#[derive(Clone, Copy)]
pub struct Level {
    pub(crate) token: fearless_simd::Level,
}

impl Level {
    /// Its name, such as "AVX-512".
    pub fn name(self) -> &'static str {
        self.names().1
    }

    /// Whether the product in a sum stays unrounded (a fused multiply-add). Levels that agree in this give the same
    /// bits.
    #[doc(hidden)]
    pub fn is_fused(self) -> bool {
        matches!(self.name(), "AVX-512" | "AVX2" | "NEON")
    }

    /// For `dispatch!`.
    #[doc(hidden)]
    pub fn token(self) -> fearless_simd::Level {
        self.token
    }

    fn names(self) -> (&'static str, &'static str) {
        NAMES[match self.token {
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Avx512(_) => 0,
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Avx2(_) => 1,
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Sse4_2(_) => 2,
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Sse2(_) => 3,
            #[cfg(target_arch = "aarch64")]
            fearless_simd::Level::Neon(_) => 4,
            _ => 5,
        }]
    }
}

impl PartialEq for Level {
    fn eq(&self, other: &Self) -> bool {
        self.names() == other.names()
    }
}

impl Eq for Level {}

impl fmt::Debug for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The levels of this CPU, the best one first.
pub fn levels() -> Vec<Level> {
    let best = fearless_simd::Level::new();
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    let all = [
        best.as_avx512().map(fearless_simd::Level::Avx512),
        best.as_avx2().map(fearless_simd::Level::Avx2),
        best.as_sse4_2().map(fearless_simd::Level::Sse4_2),
        best.as_sse2().map(fearless_simd::Level::Sse2),
        Some(best).filter(|level| level.is_fallback()),
    ];
    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    let all = [Some(best)];
    all.into_iter()
        .flatten()
        .map(|token| Level { token })
        .collect()
}

/// The level in use: that of the environment variable `HQGS_SIMD` (`avx512`, `avx2`, `sse4.2`, `sse2`, `neon`),
/// or the best one of this CPU. The variable is read once.
///
/// # Errors
/// When it names no level, or one that this CPU does not have.
pub fn level() -> Result<Level, Error> {
    static LEVEL: OnceLock<Result<Level, Error>> = OnceLock::new();
    if let Some(level) = FORCED.get() {
        return Ok(level);
    }
    LEVEL
        .get_or_init(|| match std::env::var_os(VARIABLE) {
            Some(value) => choose(&value.to_string_lossy()),
            None => Ok(levels()[0]),
        })
        .clone()
}

thread_local!(static FORCED: Cell<Option<Level>> = const { Cell::new(None) });

/// Let what `f` calls on this thread use `level`, for the tests.
#[doc(hidden)]
pub fn at_level<R>(level: Level, f: impl FnOnce() -> R) -> R {
    let before = FORCED.replace(Some(level));
    let out = f();
    FORCED.set(before);
    out
}

/// The level that the variable names; the best one if it is empty.
fn choose(wanted: &str) -> Result<Level, Error> {
    let here = levels();
    if wanted.is_empty() {
        return Ok(here[0]);
    }
    if let Some(level) = here.iter().find(|level| level.names().0 == wanted) {
        return Ok(*level);
    }
    let names: Vec<_> = here.iter().map(|level| level.names().0).collect();
    let problem = if NAMES.iter().any(|name| name.0 == wanted) {
        "this CPU does not have"
    } else {
        "there is no level"
    };
    let message = format!("{problem} {wanted:?}; use one of {}", names.join(", "));
    Err(Error::new(VARIABLE, message))
}

/// Run a test at each level of this CPU; what it prints tells at which one it failed.
#[cfg(test)]
pub(crate) fn at_each_level(test: impl Fn(Level)) {
    for level in levels() {
        println!("{}", level.name());
        test(level);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_level_is_found_by_its_name() {
        let all = levels();
        assert!(choose("").unwrap() == all[0]);
        for (i, level) in all.iter().enumerate() {
            assert_eq!(choose(level.names().0).unwrap(), *level);
            assert!(!all[..i].contains(level), "{level:?} twice");
        }
    }

    #[test]
    fn other_names_are_refused_with_those_that_there_are() {
        let here = levels()[0].names().0;
        for (name, problem) in [
            ("avx9", "there is no level"),
            ("AVX2", "there is no level"),
            (
                if cfg!(target_arch = "x86_64") {
                    "neon"
                } else {
                    "avx2"
                },
                "this CPU does not have",
            ),
        ] {
            let message = choose(name).unwrap_err().to_string();
            let expected = format!("HQGS_SIMD: {problem} {name:?}; use one of {here}");
            assert!(message.starts_with(&expected), "{message}");
        }
    }
}
