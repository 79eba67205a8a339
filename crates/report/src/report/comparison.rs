//! Compares agents that were trained outside of the experiment, as tables and as a section of a page. A condition is an
//! agent with its training distribution.

use perturb_experiment::distinct;
use perturb_records::comparison::{ComparedCondition, ComparedScore, ConditionComparison, compare};
use perturb_records::{ExternalEvaluation, ExternalPolicy, Records};
use perturb_text::Table;

/// Explanation, for users, of the intervals in a comparison.
const INTERVALS_NOTE: &str = "\
All intervals are 95 % intervals. Intervals over seeds are t intervals: they cover the mean in 95 % of cases, even with\n\
three seeds, if the means of seeds are normally distributed. Fewer than three seeds have no interval. Intervals over\n\
episodes describe these policies in other episodes. p is the p-value of t tests over seeds, with Holm's correction.";

/// Explanation, for users, of the intervals that a comparison of rows of a results table lacks.
const COUNTS_NOTE: &str = "\
Rows of a results table have no episodes. Intervals of success rates over episodes are from the numbers of successes, as if\n\
all policies had played different episodes. Returns and lengths have no interval over episodes.";

/// The comparison of several conditions in one environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentComparison {
    /// The environment's name.
    pub environment: String,
    /// The means of each condition, and the differences between conditions.
    pub comparison: ConditionComparison,
}

/// Compares the success rates of agents that were trained outside of the experiment, in each environment with at least
/// two such agents. Only tests that all of these agents have are compared. An agent's policies with the same training
/// distribution count as its seeds.
pub(super) fn comparisons_of(assessed: &[ExternalEvaluation]) -> Vec<EnvironmentComparison> {
    let environments = distinct(assessed.iter().map(ExternalEvaluation::environment));
    environments.into_iter().filter_map(|environment| comparison_in(environment, assessed)).collect()
}

/// Compares the agents in one environment. Returns `None` if there are fewer than two agents, or if they cannot be
/// compared.
fn comparison_in(environment: &str, assessed: &[ExternalEvaluation]) -> Option<EnvironmentComparison> {
    let here = assessed.iter().filter(|one| one.environment() == environment);
    let policies: Vec<(&str, &ExternalPolicy)> =
        here.flat_map(|one| one.policies().iter().map(|policy| (one.agent.as_str(), policy))).collect();
    let kinds = distinct(policies.iter().map(|(agent, policy)| (*agent, policy.trained_on())));
    let agents = distinct(kinds.iter().map(|(agent, _)| *agent));
    if agents.len() < 2 {
        return None;
    }
    // Names a condition after its agent. If an agent has several training distributions, adds the training
    // distribution.
    let condition = |&(agent, trained_on)| {
        let own = policies.iter().filter(|(name, policy)| (*name, policy.trained_on()) == (agent, trained_on));
        let keyed = own.enumerate().map(|(index, (_, policy))| ((index + 1).to_string(), &policy.records));
        let name = if kinds.len() > agents.len() { format!("{agent} on {trained_on}") } else { agent.to_owned() };
        ComparedCondition { name, policies: keyed.collect() }
    };
    let conditions: Vec<ComparedCondition<'_>> = kinds.iter().map(condition).collect();
    // Compares only tests that all policies have.
    let names = |records: &Records| records.about.tests.iter().map(|test| test.set.name.clone()).collect::<Vec<_>>();
    let mut common = names(&policies[0].1.records);
    common.retain(|name| policies.iter().all(|(_, policy)| names(&policy.records).contains(name)));
    // There is no comparison if agents were tested or judged differently.
    let comparison = compare(&conditions, &common, ComparedScore::Success, None).ok()?;
    Some(EnvironmentComparison { environment: environment.to_owned(), comparison })
}

impl EnvironmentComparison {
    /// Returns the explanation of the intervals.
    pub fn note(&self) -> String {
        if self.comparison.from_counts { format!("{INTERVALS_NOTE}\n{COUNTS_NOTE}") } else { INTERVALS_NOTE.into() }
    }

    /// Returns the table of means and, if there are several conditions, the table of differences.
    pub fn tables(&self) -> Vec<Table> {
        let differences = (!self.comparison.differences.is_empty()).then(|| self.differences_table());
        std::iter::once(self.means_table()).chain(differences).collect()
    }

    /// Returns the table of each condition's mean in each test.
    fn means_table(&self) -> Table {
        let score = match self.comparison.score {
            ComparedScore::Success => "success, %",
            ComparedScore::Return => "return",
            ComparedScore::Length => "length",
        };
        Table::builder(format!("{}: conditions", self.environment), &self.comparison.means)
            .text("condition", |row| &row.condition)
            .text("tested on", |row| &row.tested_on)
            .number("seeds", |row| row.by_seed.len())
            .number(score, |row| format!("{:.1}", row.mean))
            .number("95 % over seeds", |row| interval(row.seeds_95))
            .number("episodes", |row| row.episodes)
            .number("95 % over episodes", |row| interval(row.episodes_95))
            .build()
    }

    /// Returns the table of differences between conditions in each test.
    fn differences_table(&self) -> Table {
        let unit = match self.comparison.score {
            ComparedScore::Success => "points",
            ComparedScore::Return => "difference",
            ComparedScore::Length => "steps",
        };
        let number = |number: &f64| format!("{:+.1}", number + 0.0);
        Table::builder(format!("{}: differences", self.environment), &self.comparison.differences)
            .text("difference", |row| format!("{} − {}", row.x, row.y))
            .text("tested on", |row| &row.tested_on)
            .number(unit, move |row| number(&row.difference))
            .number("by seed", move |row| match row.paired {
                true => row.by_seed.iter().map(number).collect::<Vec<_>>().join(", "),
                false => "unpaired".into(),
            })
            .number("95 % over seeds", |row| interval(row.seeds_95))
            .number("95 % over episodes", |row| interval(row.episodes_95))
            .number("P(x > y)", |row| format!("{:.2}", row.improvement))
            .number("p, Holm", |row| row.p_holm.map_or_else(String::new, |p| format!("{p:.3}")))
            .build()
    }
}

/// Formats an interval. Returns an empty text if there is none.
fn interval(ends: Option<[f64; 2]>) -> String {
    ends.map_or_else(String::new, |[low, high]| format!("[{:.1}, {:.1}]", low + 0.0, high + 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;
    use perturb_protocol::Version;

    #[test]
    fn agents_of_an_environment_are_compared_over_their_policies() {
        let agent = |name: &str, environment: &str, successes| {
            fixture::assessed(name, environment, &[Some(Version::R)], [200, successes, 100])
        };
        let assessed = [agent("PPO", "CartPole", 200), agent("SAC", "CartPole", 190), agent("PPO", "Pendulum", 200)];
        let compared = comparisons_of(&assessed);
        let [EnvironmentComparison { environment, comparison }] = &compared[..] else { panic!("{compared:?}") };
        assert_eq!((environment.as_str(), comparison.means.len()), ("CartPole", 2 * 3), "two agents in three tests");
        let on_r = comparison.differences.iter().find(|row| row.tested_on == "R").unwrap();
        assert_eq!((on_r.x.as_str(), on_r.y.as_str(), on_r.seeds), ("SAC", "PPO", [1, 1]));
        assert_eq!(compared[0].tables().len(), 2);
        assert!(comparisons_of(&assessed[1..]).is_empty(), "one agent in each environment");
    }
}
