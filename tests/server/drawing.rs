//! The renderer without a server: its queue, abandoned requests, absurd scenes, failures.

use futures_util::future::join_all;
use perturb::{
    render::{Renderer, Size},
    scene::{Drawing, Graph, Scene, Shape, colour},
};

/// A number of requests larger than the renderer's queue.
const MANY: usize = 200;
const SIZE: Size = Size { width: 24, height: 16 };

/// Returns a drawing of a disc at `x`.
fn disc(x: f64) -> Scene {
    let mut drawing = Drawing::new([-3.0, -1.0], [3.0, 1.0]);
    drawing.disc([x, 0.0], 0.5, colour::BLUE);
    Scene::Drawing(drawing)
}

fn run<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().build().unwrap().block_on(future)
}

#[test]
fn pictures_beyond_the_queue_are_all_drawn() {
    let renderer = Renderer::new();
    let position = |i: usize| (i % 7) as f64 - 3.0;
    run(async {
        let pictures = join_all((0..MANY).map(|i| renderer.draw(disc(position(i)), SIZE))).await;
        for (i, picture) in pictures.into_iter().enumerate() {
            assert!(picture.unwrap() == renderer.draw(disc(position(i)), SIZE).await.unwrap(), "{i}");
        }
    });
}

#[test]
fn a_request_that_is_given_up_does_not_hold_up_the_others() {
    let renderer = Renderer::new();
    run(async {
        let expected = renderer.draw(disc(0.0), SIZE).await.unwrap();
        for _ in 0..MANY {
            let given_up = renderer.draw(disc(1.0), Size { width: 2048, height: 2048 });
            tokio::select! {
                biased;
                _ = given_up => {}
                () = std::future::ready(()) => {}
            }
        }
        assert_eq!(renderer.draw(disc(0.0), SIZE).await.unwrap(), expected);
    });
}

#[test]
fn absurd_numbers_are_drawn_somehow() {
    let renderer = Renderer::new();
    let absurd = [0.0, 1e-300, -1.0, 100.0, -1e9, 1e30, f64::MAX];
    let sizes = [SIZE, Size { width: 2048, height: 16 }, Size { width: 16, height: 2048 }];
    let pairs = absurd.into_iter().flat_map(|x| absurd.map(|y| (x, y)));
    for ((x, y), size) in pairs.zip(sizes.into_iter().cycle()) {
        let graph = Graph { height: |x| x * x, from: x, to: y };
        let (points, colour) = (vec![[x, y], [y, x], [0.0, 0.0]], colour::BLUE);
        let shapes = [
            Shape::Polygon { corners: points.clone(), colour },
            Shape::Disc { centre: [x, y], radius: y, colour },
            Shape::Line { points: points.clone(), width: x, colour },
            Shape::Dashes { points, width: y, colour },
            Shape::Graph { graph, width: y, colour },
            Shape::Ground { graph, colour },
        ];
        for (low, high) in [([-1.0, -1.0], [1.0, 1.0]), ([-x, -y], [x, y])] {
            let scene = Scene::Drawing(Drawing { low, high, shapes: shapes.to_vec() });
            let picture = run(renderer.draw(scene.clone(), size));
            let bytes = 3 * usize::from(size.width) * usize::from(size.height);
            assert_eq!(picture.map(|pixels| pixels.len()), Ok(bytes), "{scene:?}");
        }
    }
}

#[test]
fn an_infinite_coordinate_is_the_pictures_edge() {
    let renderer = Renderer::new();
    let draw = |low: [f64; 2], high: [f64; 2]| {
        let mut drawing = Drawing::new([-1.0, -1.0], [1.0, 1.0]);
        drawing.rectangle(low, high, colour::BLUE);
        run(renderer.draw(Scene::Drawing(drawing), Size { width: 48, height: 16 })).unwrap()
    };
    let (least, most) = (f64::NEG_INFINITY, f64::INFINITY);
    assert_eq!(draw([least, least], [0.0, 0.0]), draw([-3.0, -1.0], [0.0, 0.0]));
    assert_eq!(draw([0.0, 0.0], [most, most]), draw([0.0, 0.0], [3.0, 1.0]));
}

#[cfg(feature = "mujoco")]
#[test]
fn a_failed_drawing_fails_alone() {
    use perturb::{
        env::Environment,
        render::Error,
        scene::{Look, PosedModel},
        tasks,
    };

    let Some(Scene::Model(PosedModel { look, qpos, .. })) = tasks::hopper::hopper().unwrap().scene() else {
        panic!("a new hopper can be seen")
    };
    let renderer = Renderer::new();
    let draw = |look, qpos: &[f64]| {
        run(renderer.draw(Scene::Model(PosedModel { look, edited: None, qpos: qpos.to_vec() }), SIZE))
    };
    let expected = draw(look, &qpos).unwrap();
    // The positions have the length of another robot's, which only a defect could cause.
    assert_eq!(draw(look, &qpos[1..]), Err(Error::Defect));
    assert_eq!(draw(look, &qpos), Ok(expected.clone()));
    // After a model that cannot be compiled, the thread starts again with an empty cache. Later pictures must be equal
    // nevertheless.
    for (mjcf, words) in [("<mujoco/>", "no end"), ("<mujoco></mujoco>", "torso")] {
        let bad: &'static Look = Box::leak(Box::new(Look { mjcf, ..*look }));
        let Err(Error::Failed { environment: "Hopper", reason }) = draw(bad, &qpos) else { panic!("it was drawn") };
        assert!(reason.contains(words), "{reason}");
    }
    assert_eq!(draw(look, &qpos), Ok(expected));
}
