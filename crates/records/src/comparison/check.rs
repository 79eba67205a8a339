//! Checks that conditions can be compared.

use std::collections::BTreeSet;

use perturb_settings::{ValueError, require};

use super::ComparedCondition;
use crate::records::{Records, RecordsMetadata};

/// Refuses a condition without policies, two conditions with the same name, and an unknown baseline. `conditions` has
/// the name and the number of policies of each condition.
pub(super) fn names(conditions: &[(&str, usize)], baseline: Option<&str>) -> Result<(), ValueError> {
    require(!conditions.is_empty(), "a comparison", "of nothing", "of at least one condition")?;
    let mut names = BTreeSet::new();
    for (name, policies) in conditions {
        require(*policies > 0, format!("condition {name}"), "without policies", "of at least one policy")?;
        require(
            names.insert(name),
            "the name of a condition",
            format!("`{name}` twice"),
            "another for each condition",
        )?;
    }
    let Some(baseline) = baseline else { return Ok(()) };
    let expected = conditions.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
    let is_known = conditions.iter().any(|(name, _)| *name == baseline);
    require(is_known, "the baseline", format!("`{baseline}`"), format!("one of {expected}"))
}

/// Refuses an empty list of test sets.
pub(super) fn sets(sets: &[String]) -> Result<(), ValueError> {
    require(!sets.is_empty(), "a comparison", "without tests", "in tests that all conditions have")
}

/// Refuses policies that lack a test on one of `sets`. Also refuses policies that differ in environment, success rule,
/// or the parameters of a test set.
pub(super) fn records(conditions: &[ComparedCondition<'_>], sets: &[String]) -> Result<(), ValueError> {
    self::sets(sets)?;
    // All policies must have the environment, the success rule and the sets of the first policy.
    let first = conditions[0].policies[0].1;
    for ComparedCondition { name, policies } in conditions {
        for (_, records) in policies {
            let (about, expected) = (&records.about, &first.about);
            let what = |what: &str| format!("{what} of {name}");
            let environment = |it: &RecordsMetadata| format!("{} (revision {})", it.environment, it.revision);
            let same = (&about.environment, about.revision) == (&expected.environment, expected.revision);
            require(
                same,
                what("the environment"),
                environment(about),
                format!("{}, like the others'", environment(expected)),
            )?;
            let rule = |it: &RecordsMetadata| it.success.as_ref().map_or("the server's".into(), ToString::to_string);
            let same = about.success == expected.success;
            require(same, what("the rule of success"), rule(about), format!("{}, like the others'", rule(expected)))?;
            for set in sets {
                let test =
                    |it: &Records| it.about.tests.iter().find(|test| test.set.name == *set).map(|it| it.set.clone());
                let tested = about.tests.iter().map(|test| test.set.name.as_str()).collect::<Vec<_>>().join(", ");
                let (own, others) = (test(records), test(first));
                require(own.is_some(), what("the list of tests"), tested, format!("one with {set}, like the others'"))?;
                require(
                    own == others,
                    what(&format!("the set {set}")),
                    "of other parameters",
                    "the same in all conditions",
                )?;
            }
        }
    }
    Ok(())
}
