//! Models that use files: the caller passes the content of the files, and none is read from the disk.

use perturb_mujoco::{ElementKind, Error, Model};

/// A tetrahedron with three edges of 1 m along the axes, as binary STL.
fn tetrahedron() -> Vec<u8> {
    let corners = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let mut bytes = vec![0; 80];
    bytes.extend(4u32.to_le_bytes());
    for face in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
        let normal = [0.0f32; 3];
        let points = face.map(|corner: usize| corners[corner]).concat();
        bytes.extend(normal.iter().chain(&points).flat_map(|x| x.to_le_bytes()));
        bytes.extend([0, 0]);
    }
    bytes
}

const MODEL: &str = r#"
<mujoco>
  <compiler exactmeshinertia="true"/>
  <asset><mesh name="corner" file="m0.stl"/></asset>
  <worldbody><body name="corner"><freejoint/><geom name="corner" type="mesh" mesh="corner"/></body></worldbody>
</mujoco>"#;

#[test]
fn a_mesh_comes_from_the_given_bytes() {
    let mesh = tetrahedron();
    let model = Model::from_files(MODEL, &[("other.stl", b"unused"), ("m0.stl", &mesh)]).unwrap();
    let body = model.id(ElementKind::Body, "corner").unwrap();
    let volume = model.body_mass()[body] / 1000.0;
    // MuJoCo stores the vertices as float32, relative to the centre of mass. The volume therefore has about eight exact
    // digits.
    assert!((volume - 1.0 / 6.0).abs() < 1e-8, "{volume} m³");
}

#[test]
fn a_file_that_is_not_given_is_an_error() {
    let error = Model::from_files(MODEL, &[("m1.stl", &tetrahedron())]).unwrap_err();
    assert!(matches!(&error, Error::Compile { reason } if reason.contains("m0.stl")), "{error}");
}

#[test]
fn too_many_files_and_long_names_are_errors() {
    let many: Vec<(&str, &[u8])> = vec![("a.stl", b""); 2000];
    assert!(matches!(Model::from_files(MODEL, &many), Err(Error::Compile { .. })));
    let long = "a".repeat(1000);
    assert!(matches!(Model::from_files(MODEL, &[(&long, b"")]), Err(Error::Compile { .. })));
    assert!(matches!(Model::from_files(MODEL, &[("a\0", b"")]), Err(Error::Compile { .. })));
}
