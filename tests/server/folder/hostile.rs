//! Models that make MuJoCo abort or use all memory. The server refuses to start with such a model, and says why.

use super::{CART, TASK, folder};
use crate::common::server;

fn refused(model: &str) -> String {
    let folder = folder(&[("task.toml", TASK), ("cart.xml", model)]);
    let output = server::command().args(["--check", "--task"]).arg(folder.path()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    errors
}

#[test]
fn models_that_abort_mujoco_are_refused() {
    for size in ["nkey=\"2000000000\"", "nuser_geom=\"2000000000\""] {
        let model = CART.replace("<size ", &format!("<size {size} "));
        let errors = refused(&model);
        assert!(errors.contains("MuJoCo"), "{size}: {errors}");
    }
}

#[test]
fn a_height_field_of_gigabytes_is_refused() {
    let asset = "<asset><hfield name=\"h\" nrow=\"60000\" ncol=\"60000\" size=\"1 1 1 1\"/></asset><worldbody>";
    let errors = refused(&CART.replace("<worldbody>", asset));
    assert!(errors.contains("MuJoCo"), "{errors}");
}

#[test]
fn a_composite_of_millions_is_refused_before_it_is_compiled() {
    let composite = r#"<body name="block" pos="0 0 5"><composite type="box" count="200 200 200" spacing="0.1"><geom size="0.01"/></composite></body></worldbody>"#;
    let errors = refused(&CART.replace("</worldbody>", composite));
    assert!(errors.contains("this composite has 8000000 elements; give at most 10000"), "{errors}");
}

#[test]
fn entities_are_not_expanded() {
    let bomb =
        format!("<!DOCTYPE x [<!ENTITY a \"{0}\"><!ENTITY b \"{1}\">]>\n{CART}", "a".repeat(1000), "&a;".repeat(1000));
    let errors = refused(&bomb);
    assert!(errors.contains("this is not XML") || errors.contains("DTD"), "{errors}");
}

#[test]
fn deep_elements_are_refused() {
    let deep = format!("{}{}", "<body>".repeat(5000), "</body>".repeat(5000));
    let errors = refused(&CART.replace("<worldbody>", &format!("<worldbody>{deep}")));
    assert!(errors.contains("deep") || errors.contains("not XML"), "{errors}");
}

#[test]
fn names_with_control_characters_are_escaped() {
    let task = TASK.replace("joint = \"hinge\", get", "joint = \"\\u001b[31mred\\n\", get");
    let folder = folder(&[("task.toml", &task), ("cart.xml", CART)]);
    let output = server::command().args(["--check", "--task"]).arg(folder.path()).output().unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("red") && !errors.contains('\u{1b}') && errors.lines().count() == 1, "{errors}");
}
