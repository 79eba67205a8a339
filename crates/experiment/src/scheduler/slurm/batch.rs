//! Divides cells into jobs of some minutes each. Shorter jobs would waste time, because every job costs Slurm and its
//! node some seconds.

use super::MAX_CELLS_PER_JOB;

/// Intended duration of a job in seconds. Before similar cells have finished, most jobs end earlier, because estimates
/// then assume that every episode lasts until the step limit.
pub(super) const JOB_SECONDS: f64 = 300.0;

/// Maximum size of a job.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum JobSize {
    /// Maximum number of cells.
    Cells(usize),
    /// Maximum sum of the cells' estimated durations, in seconds.
    Seconds(f64),
}

/// A cell to submit, with its estimated duration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CellLoad {
    /// The index of the cell in the plan.
    pub(super) cell: usize,
    /// The estimated duration in seconds.
    pub(super) seconds: f64,
}

/// Divides the cells of `groups` into at most `max_jobs` jobs, in order. All cells of a job are from one group. If
/// `size` is in seconds and gives too many jobs, jobs become longer. If there are still too many jobs, the cells of the
/// last jobs are left out and wait for a later submission. Returns the indices of each job's cells.
pub(super) fn batches(groups: &[Vec<CellLoad>], mut size: JobSize, max_jobs: usize) -> Vec<Vec<usize>> {
    let all: f64 = groups.iter().flatten().map(|load| load.seconds).sum();
    loop {
        let mut jobs: Vec<Vec<usize>> = groups.iter().flat_map(|group| cut(group, size)).collect();
        match &mut size {
            JobSize::Seconds(seconds) if jobs.len() > max_jobs && *seconds < all => *seconds *= 1.5,
            _ => {
                jobs.truncate(max_jobs);
                return jobs;
            }
        }
    }
}

/// Divides the cells of one group into jobs of at most `size`, in order.
fn cut(group: &[CellLoad], size: JobSize) -> Vec<Vec<usize>> {
    let mut jobs: Vec<Vec<usize>> = Vec::new();
    let mut filling = 0.0;
    for load in group {
        let (weight, room) = match size {
            JobSize::Cells(cells) => (1.0, cells as f64),
            JobSize::Seconds(seconds) => (load.seconds, seconds),
        };
        match jobs.last_mut() {
            Some(job) if job.len() < MAX_CELLS_PER_JOB && filling + weight <= room => {
                job.push(load.cell);
                filling += weight;
            }
            _ => {
                jobs.push(vec![load.cell]);
                filling = weight;
            }
        }
    }
    jobs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns one group of cells with these estimated durations, in seconds.
    fn loads(seconds: &[f64]) -> Vec<Vec<CellLoad>> {
        vec![seconds.iter().enumerate().map(|(cell, &seconds)| CellLoad { cell, seconds }).collect()]
    }

    #[test]
    fn jobs_take_minutes_and_keep_the_order() {
        let loads = loads(&[100.0, 150.0, 60.0, 400.0, 10.0, 290.0]);
        let jobs = batches(&loads, JobSize::Seconds(300.0), 1000);
        assert_eq!(jobs, [vec![0, 1], vec![2], vec![3], vec![4, 5]]);
        assert_eq!(batches(&loads, JobSize::Cells(4), 1000), [vec![0, 1, 2, 3], vec![4, 5]]);
        assert!(batches(&[], JobSize::Cells(4), 1000).is_empty());
    }

    #[test]
    fn jobs_become_longer_if_there_may_not_be_so_many() {
        let loads = loads(&[300.0; 40]);
        assert_eq!(batches(&loads, JobSize::Seconds(300.0), 40).len(), 40);
        let jobs = batches(&loads, JobSize::Seconds(300.0), 10);
        assert!(jobs.len() <= 10 && jobs.len() > 5, "{jobs:?}");
        assert_eq!(jobs.concat(), (0..40).collect::<Vec<_>>());
        assert_eq!(
            batches(&loads, JobSize::Cells(3), 10).concat(),
            (0..30).collect::<Vec<_>>(),
            "the rest comes later"
        );
    }

    #[test]
    fn a_job_has_no_more_cells_than_fit_in_an_argument() {
        let loads = loads(&vec![0.0; 2500]);
        let jobs = batches(&loads, JobSize::Seconds(300.0), 2);
        assert_eq!(jobs.iter().map(Vec::len).collect::<Vec<_>>(), [1000, 1000]);
        let jobs = batches(&loads, JobSize::Seconds(300.0), 3);
        assert_eq!(jobs.iter().map(Vec::len).collect::<Vec<_>>(), [1000, 1000, 500]);
    }

    #[test]
    fn a_job_has_cells_of_one_group() {
        let all = &loads(&[1.0; 6])[0];
        let groups = [all[..2].to_vec(), all[2..3].to_vec(), all[3..].to_vec()];
        assert_eq!(batches(&groups, JobSize::Cells(2), 1000), [vec![0, 1], vec![2], vec![3, 4], vec![5]]);
        assert_eq!(batches(&groups, JobSize::Seconds(9.0), 1000), [vec![0, 1], vec![2], vec![3, 4, 5]]);
        assert_eq!(batches(&groups, JobSize::Seconds(9.0), 2).len(), 2, "it ends, although groups cannot share a job");
    }
}
