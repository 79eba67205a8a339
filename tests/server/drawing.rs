//! The renderer in process: its queue, what is given up, what is absurd, what fails.

use futures_util::future::join_all;
use perturb::{
    env::Pose,
    render::{Renderer, Size},
};

/// More requests than wait for the thread.
const MANY: usize = 200;
const SIZE: Size = Size { width: 24, height: 16 };

fn cart(position: f64) -> Pose {
    Pose::CartPole { position, angle: 0.1, half_pole_length: 0.5, position_limit: 2.4, angle_limit: 0.2 }
}

fn run<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().build().unwrap().block_on(future)
}

#[test]
fn more_requests_than_the_queue_holds_are_all_answered_each_with_its_own_picture() {
    let renderer = Renderer::new();
    let position = |i: usize| (i % 7) as f64 - 3.0;
    run(async {
        let pictures = join_all((0..MANY).map(|i| renderer.draw(cart(position(i)), SIZE))).await;
        for (i, picture) in pictures.into_iter().enumerate() {
            assert!(picture.unwrap() == renderer.draw(cart(position(i)), SIZE).await.unwrap(), "{i}");
        }
    });
}

#[test]
fn a_request_that_is_given_up_does_not_hold_up_the_others() {
    let renderer = Renderer::new();
    run(async {
        let expected = renderer.draw(cart(0.0), SIZE).await.unwrap();
        for _ in 0..MANY {
            let given_up = renderer.draw(cart(1.0), Size { width: 2048, height: 2048 });
            tokio::select! {
                biased;
                _ = given_up => {}
                () = std::future::ready(()) => {}
            }
        }
        assert_eq!(renderer.draw(cart(0.0), SIZE).await.unwrap(), expected);
    });
}

#[test]
fn absurd_numbers_are_drawn_somehow() {
    let renderer = Renderer::new();
    let absurd = [0.0, 1e-300, -1.0, 100.0, -1e9, 1e30, f64::MAX];
    let sizes = [SIZE, Size { width: 2048, height: 16 }, Size { width: 16, height: 2048 }];
    let pairs = absurd.into_iter().flat_map(|x| absurd.map(|y| (x, y)));
    for ((x, y), size) in pairs.zip(sizes.into_iter().cycle()) {
        let poses = [
            Pose::CartPole { position: x, angle: y, half_pole_length: y, position_limit: 2.4, angle_limit: 0.2 },
            Pose::MountainCar { position: x, low: -1.2, high: 0.6, goal: y },
            Pose::Acrobot { angles: [x, y], link_length: y.abs(), goal_height: x },
            Pose::Pendulum { angle: x, length: y, upright: 1.0, torque: Some(x) },
        ];
        for pose in poses {
            let picture = run(renderer.draw(pose.clone(), size));
            let bytes = 3 * usize::from(size.width) * usize::from(size.height);
            assert_eq!(picture.map(|pixels| pixels.len()), Ok(bytes), "{pose:?}");
        }
    }
}

#[cfg(feature = "mujoco")]
#[test]
fn a_failed_drawing_fails_alone() {
    use perturb::render::Error;

    let renderer = Renderer::new();
    let mjcf = include_str!("../../models/hopper.xml");
    let hopper = |mjcf, n| renderer.draw(Pose::Robot { name: "Hopper", mjcf, qpos: vec![0.1; n] }, SIZE);
    let expected = run(hopper(mjcf, 6)).unwrap();
    // A defect: positions of another robot.
    assert_eq!(run(hopper(mjcf, 5)), Err(Error::Defect));
    assert_eq!(run(hopper(mjcf, 6)), Ok(expected.clone()));
    // A robot that nobody knows makes the thread start afresh, which leaves no trace either.
    let unknown = Pose::Robot { name: "Walker", mjcf, qpos: vec![0.0; 6] };
    let Err(Error::Failed { environment: "Walker", reason }) = run(renderer.draw(unknown, SIZE)) else {
        panic!("it was drawn")
    };
    assert!(reason.contains("how to show Walker"), "{reason}");
    let Err(Error::Failed { environment: "Hopper", reason }) = run(hopper("<mujoco/>", 6)) else {
        panic!("it was drawn")
    };
    assert!(reason.contains("no end"), "{reason}");
    assert_eq!(run(hopper(mjcf, 6)), Ok(expected));
}
