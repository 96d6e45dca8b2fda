//! Options, records and progress: what is refused, and what is counted.

use pss_guide::{GuideError, Records, fit, registry};

use crate::common::{self, Target, options, two_paths};

#[test]
fn options_are_checked_by_name_type_and_range() {
    for spec in registry() {
        let defaults = (spec.defaults)();
        (spec.validate)(&defaults).unwrap();
        let error = (spec.validate)(&options(&[("epoch", 3.into())]))
            .unwrap_err()
            .to_string();
        let known = defaults.keys().cloned().collect::<Vec<_>>().join(", ");
        assert_eq!(
            error,
            format!(
                "guide {:?} has no option \"epoch\" (known: {known})",
                spec.name
            )
        );
        for option in defaults.keys() {
            for value in [
                serde_json::json!("x"),
                serde_json::json!(-1),
                serde_json::json!([1]),
            ] {
                let error = (spec.validate)(&options(&[(option, value.clone())]))
                    .unwrap_err()
                    .to_string();
                let want = format!("guide {:?}: option {option} = ", spec.name);
                assert!(
                    error.starts_with(&want) && error.contains(" is not accepted: "),
                    "{error}"
                );
            }
        }
    }
    let error = fit("realnpv", &options(&[]), &two_paths(), 1, &mut |_| true).unwrap_err();
    let known: Vec<_> = registry().iter().map(|spec| spec.name).collect();
    assert_eq!(
        error.to_string(),
        format!(
            "no guide is named \"realnpv\" (known: {})",
            known.join(", ")
        )
    );
}

#[test]
fn bad_paths_are_dropped_counted_or_refused() {
    for spec in registry() {
        let mut u = common::uniform(2000, 2, 6);
        let mut f = vec![1.0; 2000];
        (f[3], f[7], f[11]) = (f32::NAN, f32::INFINITY, 1e30);
        u[20] = f32::NAN;
        let g = vec![1.0; 2000];
        let records = Records {
            zeros: 9,
            ..common::records(2, &u, &f, &g)
        };
        let fitted = fit(
            spec.name,
            &common::epochs(spec.name, 1),
            &records,
            1,
            &mut |_| true,
        )
        .unwrap();
        assert_eq!(fitted.dropped_nonfinite, 3, "{}", spec.name);
        assert_eq!(
            fitted.outliers_removed + fitted.trained_on,
            1997,
            "{}",
            spec.name
        );
        // Histograms keep the brightest path, at no more than the quantile's weight.
        let removes = (spec.defaults)().contains_key("outlier_quantile");
        assert_eq!(fitted.outliers_removed, usize::from(removes));

        let black = vec![0.0; 2000];
        let records = Records {
            f: &black,
            f_max: &black,
            ..records
        };
        let error = fit(spec.name, &options(&[]), &records, 1, &mut |_| true).unwrap_err();
        assert!(
            matches!(
                error,
                GuideError::TooFewPaths {
                    usable: 0,
                    given: 2000,
                    nonfinite: 1,
                    zeros: 9
                }
            ),
            "{error}"
        );
    }
}

#[test]
fn a_fit_can_be_cancelled_and_reports_its_progress() {
    for spec in registry() {
        let target = Target { dims: 2 };
        let (u, f) = target.paths(2000, 1);
        let g = vec![1.0; 2000];
        let records = common::records(2, &u, &f, &g);
        let mut seen = Vec::new();
        let mut cancel = |share| {
            seen.push(share);
            share < 0.3
        };
        let error = fit(spec.name, &options(&[]), &records, 1, &mut cancel).unwrap_err();
        assert!(matches!(error, GuideError::Cancelled), "{error}");
        assert!(seen.is_sorted() && seen.len() > 3, "{seen:?}");
        let mut last = 0.0;
        fit(
            spec.name,
            &common::epochs(spec.name, 1),
            &records,
            1,
            &mut |share| {
                last = share;
                true
            },
        )
        .unwrap();
        assert_eq!(last, 1.0);
    }
}

#[test]
fn a_diverging_fit_says_where_and_what_to_do() {
    // Steps of 1 with couplings that may stretch by e¹⁶ each overflow at once.
    let target = Target { dims: 2 };
    let (u, f) = target.paths(4000, 1);
    let g = vec![1.0; 4000];
    let records = common::records(2, &u, &f, &g);
    let given = options(&[
        ("learning_rate", 1.0.into()),
        ("s_max", 16.0.into()),
        ("couplings", 64.into()),
        ("epochs", 50.into()),
    ]);
    let error = fit("realnvp", &given, &records, 1, &mut |_| true)
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("guide \"realnvp\": training diverged in epoch ")
            && error.contains("`learning_rate`"),
        "{error}"
    );
}
