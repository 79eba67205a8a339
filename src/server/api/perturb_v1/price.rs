//! The price of each request, in steps of one environment, for the rate limits of tokens. docs/access.md has the table.

use crate::{pool::Batch, proto::session_request::Request};

/// The price of `open` without the price of its environments. This price covers the session's buffers and its line in
/// the log.
const OPEN_PRICE: u64 = 16;
/// The price of each restored environment.
const RESTORED_PRICE: u64 = 4;
/// The number of pixels of a picture that are charged as one step.
const PIXELS_PER_STEP: u64 = 1024;
/// The fixed part of the price of each request other than `open`, `step` and `act`.
const REQUEST_PRICE: u64 = 1;

/// Returns the price of a request, not counting the steps that the request runs. The price of `step` and `act` is 0.
/// The environments of an `open` are charged separately when they are created.
pub fn price(request: Option<&Request>, batch: Option<&Batch>) -> u64 {
    let size = batch.map_or(0, Batch::size);
    let selected = |mask: &[u8]| if mask.is_empty() { size } else { mask.iter().filter(|&&entry| entry != 0).count() };
    let each = |count: usize| count as u64;
    match request {
        Some(Request::Step(_) | Request::Act(_)) => 0,
        Some(Request::Open(_)) => OPEN_PRICE,
        Some(Request::Reset(reset)) => {
            let is_new_trial = !reset.seeds.is_empty() || !reset.parameters.is_empty();
            REQUEST_PRICE + each(selected(&reset.mask)) * if is_new_trial { 2 } else { 1 }
        }
        Some(Request::Snapshot(snapshot)) => REQUEST_PRICE + each(selected(&snapshot.mask)),
        Some(Request::Restore(restore)) => REQUEST_PRICE + each(selected(&restore.mask)) * RESTORED_PRICE,
        Some(Request::Render(render)) => {
            let side = |side: u32| if side == 0 { DEFAULT_SIDE } else { u64::from(side).min(MAX_SIDE) };
            REQUEST_PRICE + side(render.width) * side(render.height) / PIXELS_PER_STEP
        }
        Some(Request::Release(_) | Request::SavePlayer(_)) => REQUEST_PRICE + each(size),
        Some(Request::Resume(_)) | None => REQUEST_PRICE,
    }
}

/// The default width and height of a picture, pixels.
const DEFAULT_SIDE: u64 = 480;
/// The maximum width and height of a picture, pixels.
const MAX_SIDE: u64 = 2048;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proto::{Act, Open, Render, Reset, Restore, Snapshot, Step};
    use rstest::rstest;

    #[rstest]
    #[case::step(Request::Step(Step::default()), 0)]
    #[case::act(Request::Act(Act::default()), 0)]
    #[case::open(Request::Open(Open::default()), 16)]
    #[case::reset(Request::Reset(Reset { mask: vec![1, 0, 1].into(), ..Reset::default() }), 3)]
    #[case::new_trial(Request::Reset(Reset { mask: vec![1, 0, 1].into(), seeds: vec![1, 2], ..Reset::default() }), 5)]
    #[case::snapshot(Request::Snapshot(Snapshot { mask: vec![1; 7].into() }), 8)]
    #[case::restore(Request::Restore(Restore { mask: vec![1; 7].into(), ..Restore::default() }), 29)]
    #[case::picture(Request::Render(Render::default()), 226)]
    #[case::huge_picture(Request::Render(Render { width: u32::MAX, height: u32::MAX, slot: 0 }), 4097)]
    fn every_request_has_its_price(#[case] request: Request, #[case] expected: u64) {
        assert_eq!(price(Some(&request), None), expected);
    }
}
