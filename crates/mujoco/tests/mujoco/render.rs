//! Pictures of models. These tests need software OpenGL: Debian's libegl1 and libgl1-mesa-dri.

use perturb_mujoco::{Camera, CameraView, Error, Model, ModelRenderer};
use std::{sync::Barrier, thread};

/// A red ball and a blue ball. In the picture of [`CAMERA`] the red one is above and to the right of the blue one.
const BALLS: &str = r#"
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody>
    <body name="red" pos="0.5 0 0.5"><joint type="slide" axis="1 0 0"/><geom size=".3" rgba="1 0 0 1"/></body>
    <geom pos="-0.5 0 -0.5" size=".3" rgba="0 0 1 1"/>
  </worldbody>
</mujoco>"#;
const CAMERA: Camera = Camera { look_at: [0.0; 3], distance: 3.0, azimuth: 90.0, elevation: 0.0 };

fn renderer(size: (u16, u16)) -> ModelRenderer {
    ModelRenderer::new(Model::from_xml(BALLS).unwrap(), size).unwrap()
}

fn pixel(picture: &[u8], (width, x, y): (usize, usize, usize)) -> [u8; 3] {
    picture.as_chunks::<3>().0[width * y + x]
}

#[test]
fn first_row_is_the_uppermost_at_every_size() {
    let mut renderer = renderer((100, 100));
    for (width, height) in [(100, 100), (101, 100), (99, 101), (102, 97)] {
        let picture = renderer.draw(CameraView::Free(CAMERA), (width, height)).unwrap();
        let (width, height) = (usize::from(width), usize::from(height));
        assert_eq!(picture.len(), 3 * width * height);
        let [red, blue] =
            [(30, 70), (70, 30)].map(|(y, x)| pixel(&picture, (width, x * width / 100, y * height / 100)));
        assert!(red[0] > 200 && red[2] < 50, "{red:?} in {width} x {height}");
        assert!(blue[2] > 200 && blue[0] < 50, "{blue:?} in {width} x {height}");
    }
}

#[test]
fn pictures_follow_the_positions_and_the_camera() {
    let mut renderer = renderer((64, 64));
    let before = renderer.draw(CameraView::Free(CAMERA), (64, 64)).unwrap();
    renderer.simulation().qpos_mut()[0] = -0.2;
    assert_eq!(
        renderer.draw(CameraView::Free(CAMERA), (64, 64)).unwrap(),
        before,
        "nothing was computed from the new position yet"
    );
    renderer.simulation().kinematics().unwrap();
    assert_ne!(renderer.draw(CameraView::Free(CAMERA), (64, 64)).unwrap(), before);
    renderer.simulation().qpos_mut()[0] = 0.0;
    renderer.simulation().kinematics().unwrap();
    assert_eq!(renderer.draw(CameraView::Free(CAMERA), (64, 64)).unwrap(), before);
    assert_ne!(renderer.draw(CameraView::Free(Camera { azimuth: 80.0, ..CAMERA }), (64, 64)).unwrap(), before);
}

#[test]
fn renderers_do_not_disturb_each_other() {
    const THREADS: usize = 3;
    let expected = renderer((80, 60)).draw(CameraView::Free(CAMERA), (80, 60)).unwrap();
    let barrier = Barrier::new(THREADS);
    thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                barrier.wait();
                for size in [(80, 60), (200, 200), (16, 16)] {
                    let (mut one, mut other) = (renderer(size), renderer((80, 60)));
                    for _ in 0..5 {
                        assert!(one.draw(CameraView::Free(CAMERA), (80, 60)).unwrap() == expected);
                        one.draw(CameraView::Free(CAMERA), (300, 20)).unwrap();
                        assert!(other.draw(CameraView::Free(CAMERA), (80, 60)).unwrap() == expected);
                    }
                }
            });
        }
    });
}

#[test]
fn what_opengl_cannot_draw_is_an_error() {
    let error = renderer((16, 16)).draw(CameraView::Free(CAMERA), (u16::MAX, u16::MAX)).unwrap_err();
    assert!(matches!(error, Error::Fatal { .. }), "{error}");
}
