//! Events of cells that run together in a group.

use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{ExperimentFolder, FailureId, FailureRecord};
use perturb_files::interrupt::StopFlag;
use perturb_learner::cell::{CellJob, run_cells};
use perturb_learner::client::Servers;

use super::{Experiment, PLAN};
use crate::common::{kill, server};

/// Runs cells as a group. Each cell is given with the earlier failure that it may retry. Returns the last event of each
/// cell, in the order of the plan.
fn ends(
    experiment: &Experiment,
    servers: &Servers,
    cells: &[(usize, Option<FailureId>)],
    stop: &StopFlag,
) -> Vec<(usize, CellEvent)> {
    let folder = ExperimentFolder::new(&experiment.out("out"));
    let order = |&(cell, retry): &(usize, Option<FailureId>)| {
        let cell = &experiment.plan.cells[cell];
        CellJob { cell, folder: folder.cell(&cell.id), retry }
    };
    let orders: Vec<CellJob<'_>> = cells.iter().map(order).collect();
    let mut told: Vec<(usize, CellEvent)> = Vec::new();
    run_cells(servers, &orders, stop, &mut |cell, event| {
        let ended = told.iter().any(|(known, event)| *known == cell.index && event.is_last());
        assert!(!ended, "{} ended already, and now {event:?}", cell.id);
        told.push((cell.index, event));
    });
    told.retain(|(_, event)| event.is_last());
    told.sort_by_key(|(cell, _)| *cell);
    told
}

#[test]
fn each_cell_of_a_group_ends_once() {
    let experiment = Experiment::new(PLAN);
    let local = server(1);
    let stop = StopFlag::default();
    let servers = Servers::connect(std::slice::from_ref(local.address())).unwrap_or_else(|error| panic!("{error}"));
    let place = |cell: usize| ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[cell].id);
    assert_eq!(ends(&experiment, &servers, &[(0, None)], &stop), [(0, CellEvent::Done)]);

    let lock = place(1).try_lock().expect("a file").expect("a lock");
    let failure = FailureRecord {
        id: experiment.plan.cells[2].id.clone(),
        reason: "NaN".into(),
        commit: "x".into(),
        requires_restart: true,
    };
    place(2).write_failure(&failure).expect("written");
    let failed = CellEvent::Failed { reason: "NaN".into() };
    let all = [0, 1, 2, 3].map(|cell| (cell, None));
    let expected = [(0, CellEvent::Done), (1, CellEvent::Busy), (2, failed), (3, CellEvent::Done)];
    assert_eq!(ends(&experiment, &servers, &all, &stop), expected);
    drop(lock);

    // First a signal stops both cells, then they lose their server, and then they run on another server.
    let left = [(1, None), (2, place(2).failure_id())];
    stop.raise(15);
    let stopped = CellEvent::Stopped { signal: 15 };
    assert_eq!(ends(&experiment, &servers, &left, &stop), [(1, stopped.clone()), (2, stopped)]);
    let left = [(1, None), (2, place(2).failure_id())];
    kill("-KILL", local.process_id());
    let lost = ends(&experiment, &servers, &left, &StopFlag::default());
    assert!(lost.len() == 2 && lost.iter().all(|(_, end)| matches!(end, CellEvent::LostServer { .. })), "{lost:?}");
    let local = server(2);
    let servers = Servers::connect(std::slice::from_ref(local.address())).unwrap_or_else(|error| panic!("{error}"));
    let left = [(2, place(2).failure_id()), (1, None)];
    let done = [(1, CellEvent::Done), (2, CellEvent::Done)];
    assert_eq!(ends(&experiment, &servers, &left, &StopFlag::default()), done);
}
