//! Inputs of a policy.

use crate::act::ActorOutput;
use crate::error::{Result, check_length};
use crate::spec::ActionKind;

/// Builds a policy's inputs from observations. Without RL², an input is the observation. With RL² it is (s_t, a_{t-1},
/// r_{t-1}, d_{t-1}), the observation with the previous step of its environment (Duan et al., 2016, arXiv:1611.02779,
/// section 2.2):
///
/// - s_t `[O]`: the normalised observation;
/// - a_{t-1}: the action, one-hot `[n]` if discrete, as sampled `[A]` if continuous;
/// - r_{t-1}: the normalised reward;
/// - d_{t-1}: the done flag, 1 if the step ended an episode, else 0.
///
/// The previous step is all 0 at the start of a trial.
#[derive(Clone, Debug)]
pub struct Inputs {
    observation_size: usize,
    action: ActionKind,
    /// `[N, E]` previous step of every environment: action, reward and done flag. E = 0 without RL².
    previous: Vec<f32>,
    /// E, the length of a previous step: the action's length + 2, or 0 without RL².
    extra: usize,
    rows: Vec<f32>,
}

impl Inputs {
    /// Creates the inputs of N = `n_envs` environments at the start of a trial. With `with_previous_step` (RL²) they
    /// include the previous action, reward and done flag.
    pub fn new(observation_size: usize, action: ActionKind, n_envs: usize, with_previous_step: bool) -> Self {
        let extra = if with_previous_step { action.outputs() + 2 } else { 0 };
        Inputs { observation_size, action, previous: vec![0.0; n_envs * extra], extra, rows: Vec::new() }
    }

    /// Returns O, the length of an observation.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Returns I = O + E, the length of an input.
    pub fn size(&self) -> usize {
        self.observation_size + self.extra
    }

    /// Returns the inputs `[N, I]` for `observations` `[N, O]` of all environments.
    pub fn from_observations<'a>(&'a mut self, observations: &'a [f32]) -> &'a [f32] {
        let n_envs = observations.len() / self.observation_size;
        self.rows(observations, 0..n_envs, false)
    }

    /// Returns the inputs `[K, I]` for the final observations `[K, O]` of `environments` `[K]`. Each contains the step
    /// that [`Inputs::remember`] stored last. Its done flag is set to 0, as if the episode had not ended.
    pub fn from_final_observations<'a>(&'a mut self, observations: &'a [f32], environments: &[usize]) -> &'a [f32] {
        self.rows(observations, environments.iter().copied(), true)
    }

    fn rows<'a>(
        &'a mut self,
        observations: &'a [f32],
        environments: impl Iterator<Item = usize>,
        unended: bool,
    ) -> &'a [f32] {
        if self.extra == 0 {
            return observations;
        }
        self.rows.clear();
        for (observation, environment) in observations.chunks_exact(self.observation_size).zip(environments) {
            self.rows.extend_from_slice(observation);
            self.rows.extend_from_slice(&self.previous[environment * self.extra..][..self.extra]);
            if let (true, Some(done)) = (unended, self.rows.last_mut()) {
                *done = 0.0;
            }
        }
        &self.rows
    }

    /// Stores a step as the previous one: its actions, its normalised `rewards` `[N]`, and `done` `[N]`, which is true
    /// where an episode ended.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if an array has the wrong length.
    pub fn remember(&mut self, acts: &ActorOutput, rewards: &[f32], done: &[bool]) -> Result<()> {
        if self.extra == 0 {
            return Ok(());
        }
        let n_envs = self.previous.len() / self.extra;
        let width = self.action.width();
        check_length("actions [N, A]", acts.actions.len(), n_envs * width)?;
        check_length("rewards [N]", rewards.len(), n_envs)?;
        check_length("done [N]", done.len(), n_envs)?;
        let rows = self.previous.chunks_exact_mut(self.extra).zip(acts.actions.chunks_exact(width));
        for ((row, action), (reward, done)) in rows.zip(rewards.iter().zip(done)) {
            let (chosen, outcome) = row.split_at_mut(self.extra - 2);
            match self.action {
                ActionKind::Continuous { .. } => chosen.copy_from_slice(action),
                ActionKind::Discrete { .. } => {
                    for (j, hot) in chosen.iter_mut().enumerate() {
                        *hot = f32::from(u8::from(j == action[0] as usize));
                    }
                }
            }
            outcome.copy_from_slice(&[*reward, f32::from(u8::from(*done))]);
        }
        Ok(())
    }

    /// Clears the previous step of `environment`. Call it at the start of a trial.
    pub fn forget(&mut self, environment: usize) {
        self.previous[environment * self.extra..][..self.extra].fill(0.0);
    }

    /// Returns the previous steps of all environments, `[N, E]`.
    pub fn previous_steps(&self) -> &[f32] {
        &self.previous
    }

    /// Restores previous steps that [`Inputs::previous_steps`] returned.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if the array has the wrong length.
    pub fn restore(&mut self, previous_steps: &[f32]) -> Result<()> {
        check_length("previous steps [N, E]", previous_steps.len(), self.previous.len())?;
        self.previous.copy_from_slice(previous_steps);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DISCRETE: ActionKind = ActionKind::Discrete { n: 3 };

    fn acts(kind: ActionKind, actions: &[f32]) -> ActorOutput {
        ActorOutput { actions: actions.to_vec(), ..ActorOutput::new(kind, 2) }
    }

    #[test]
    fn plain_inputs_are_the_observations() {
        let mut inputs = Inputs::new(2, DISCRETE, 2, false);
        inputs.remember(&acts(DISCRETE, &[1.0, 2.0]), &[0.5, 0.5], &[false, true]).unwrap();
        inputs.forget(1);
        assert_eq!((inputs.size(), inputs.from_observations(&[1.0, 2.0, 3.0, 4.0])), (2, &[1.0, 2.0, 3.0, 4.0][..]));
    }

    #[test]
    fn rl2_inputs_have_the_previous_step() {
        let mut inputs = Inputs::new(1, DISCRETE, 2, true);
        assert_eq!(inputs.size(), 1 + 3 + 1 + 1);
        assert_eq!(inputs.from_observations(&[7.0, 8.0]), [7.0, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        inputs.remember(&acts(DISCRETE, &[2.0, 0.0]), &[0.5, -0.5], &[false, true]).unwrap();
        assert_eq!(
            inputs.from_observations(&[7.0, 8.0]),
            [7.0, 0.0, 0.0, 1.0, 0.5, 0.0, 8.0, 1.0, 0.0, 0.0, -0.5, 1.0]
        );
        assert_eq!(inputs.from_final_observations(&[9.0], &[1]), [9.0, 1.0, 0.0, 0.0, -0.5, 0.0], "nothing has ended");
        inputs.forget(1);
        assert_eq!(inputs.from_observations(&[7.0, 8.0])[6..], [8.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(
            inputs.from_observations(&[7.0, 8.0])[..6],
            [7.0, 0.0, 0.0, 1.0, 0.5, 0.0],
            "the other's trial goes on"
        );

        let kind = ActionKind::Continuous { size: 2 };
        let mut inputs = Inputs::new(1, kind, 2, true);
        inputs.remember(&acts(kind, &[0.1, 0.2, 0.3, 0.4]), &[1.0, 2.0], &[true, false]).unwrap();
        assert_eq!(inputs.from_observations(&[7.0, 8.0]), [7.0, 0.1, 0.2, 1.0, 1.0, 8.0, 0.3, 0.4, 2.0, 0.0]);
        let saved = inputs.previous_steps().to_vec();
        inputs.forget(0);
        inputs.restore(&saved).unwrap();
        assert_eq!(inputs.from_observations(&[7.0, 8.0])[..5], [7.0, 0.1, 0.2, 1.0, 1.0]);
        assert!(inputs.restore(&[1.0]).is_err());
    }
}
