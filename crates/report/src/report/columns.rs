//! Columns that several tables of a report have.

use perturb_records::statistics::Summary;
use perturb_settings::Method;
use perturb_text::TableBuilder;

use super::numbers::or_empty;

/// Adds columns that several tables have to a table builder.
pub(crate) trait MethodColumns<'r, R: 'r>: Sized {
    /// Adds the columns that identify a method.
    fn method(self, method: impl Fn(&'r R) -> &'r Method) -> Self {
        self.method_as("", method)
    }

    /// Adds the columns that identify a method. Their names begin with `prefix`. The columns `preset`, `observe` and
    /// `elsewhere` are added only if some row differs from the default, so that files without such rows keep their old
    /// format.
    fn method_as(self, prefix: &str, method: impl Fn(&'r R) -> &'r Method) -> Self;

    /// Adds the columns `runs`, `mean` and `std`: number of runs, mean and standard deviation.
    fn summary(self, summary: impl Fn(&'r R) -> Option<Summary>) -> Self;
}

impl<'r, R: 'r> MethodColumns<'r, R> for TableBuilder<'r, R> {
    fn method_as(self, prefix: &str, method: impl Fn(&'r R) -> &'r Method) -> Self {
        let any = |is: fn(&Method) -> bool| self.sources().iter().any(|row| is(method(row)));
        let (presets, observes) = (any(|it| !it.preset.is_default()), any(|it| !it.observe.is_default()));
        let elsewhere = any(|it| it.external);
        let table = self
            .text(format!("{prefix}algorithm"), |row| &method(row).algorithm)
            .text(format!("{prefix}architecture"), |row| &method(row).architecture)
            .text(format!("{prefix}episodes_per_trial"), |row| or_empty(method(row).episodes_per_trial));
        let table = if presets { table.text(format!("{prefix}preset"), |row| method(row).preset) } else { table };
        let table = if observes { table.text(format!("{prefix}observe"), |row| method(row).observe) } else { table };
        if elsewhere { table.text(format!("{prefix}elsewhere"), |row| method(row).external) } else { table }
    }

    fn summary(self, summary: impl Fn(&'r R) -> Option<Summary>) -> Self {
        self.number("runs", |row| summary(row).map_or(0, |summary| summary.runs))
            .number("mean", |row| or_empty(summary(row).map(|summary| summary.mean)))
            .number("std", |row| or_empty(summary(row).and_then(|summary| summary.std)))
    }
}
