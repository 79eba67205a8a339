//! Looks up attributes in a model's MJCF text, including those that elements inherit from default classes. Also finds
//! the geoms that matter only for pictures.

use super::{
    error::Result,
    mjcf::{Text, parse},
};
use roxmltree::{Document, Node};

/// A model's parsed MJCF text.
#[derive(Clone, Copy)]
pub(super) struct ModelText<'a, 'input> {
    pub(super) document: &'a Document<'input>,
}

impl<'a, 'input> ModelText<'a, 'input> {
    /// Returns all elements with this tag name.
    pub(super) fn elements(self, tag: &'a str) -> impl Iterator<Item = Node<'a, 'input>> {
        self.document.descendants().filter(move |node| node.has_tag_name(tag))
    }

    /// Returns an attribute of an element, or the value that the element inherits from its default class.
    pub(super) fn get(self, node: Node<'a, 'input>, key: &str) -> Option<&'a str> {
        if let Some(own) = node.attribute(key) {
            return Some(own);
        }
        let childclass = || node.ancestors().skip(1).find_map(|ancestor| ancestor.attribute("childclass"));
        let class = node.attribute("class").or_else(childclass);
        let is_default = |node: &Node<'a, 'input>| node.has_tag_name("default");
        let is_class = |found: &Node<'a, 'input>| is_default(found) && found.attribute("class") == class;
        let nested = class.and_then(|_| self.document.descendants().find(is_class));
        let nested = nested.into_iter().flat_map(|found| found.ancestors().take_while(is_default));
        let top = self.document.root_element().children().filter(is_default);
        let of_class = |found: Node<'a, 'input>| {
            let elements = found.children().filter(|child| child.tag_name() == node.tag_name());
            elements.filter_map(|element| element.attribute(key)).next_back()
        };
        nested.chain(top).find_map(of_class)
    }

    /// Returns an attribute of the model's `<compiler>` elements; the last element that has it counts.
    pub(super) fn compiler(self, key: &str) -> Option<&'a str> {
        self.elements("compiler").filter_map(|node| node.attribute(key)).last()
    }

    /// Returns the `<inertial>` element of a body. Returns `None` if the body has none, or if the compiler is set to
    /// ignore such elements.
    pub(super) fn inertial(self, body: Node<'a, 'input>) -> Option<Node<'a, 'input>> {
        let inertial = body.children().find(|child| child.has_tag_name("inertial"));
        inertial.filter(|_| self.compiler("inertiafromgeom") != Some("true"))
    }

    /// Whether a geom is a mesh that affects only pictures and rangefinders: `contype` and `conaffinity` are 0, and it
    /// adds no mass to its body. Assumes that no `<pair>` declares contacts of such a mesh.
    pub(super) fn affects_only_pictures(self, geom: Node<'a, 'input>) -> bool {
        let is_zero = |key| self.get(geom, key).unwrap_or("1").trim() == "0";
        let is_mesh = self.get(geom, "type") == Some("mesh") && self.get(geom, "mesh").is_some();
        let has_inertia = geom.parent_element().is_some_and(|body| self.inertial(body).is_some());
        is_mesh && has_inertia && is_zero("contype") && is_zero("conaffinity")
    }

    /// Whether the text for the physics can omit a geom. The geom must affect only pictures, and must have no name by
    /// which a task could refer to it.
    pub(super) fn is_omitted_from_physics(self, geom: Node<'a, 'input>) -> bool {
        !geom.has_attribute("name") && self.affects_only_pictures(geom)
    }
}

/// Returns a model's text without the unnamed geoms that affect only pictures, and without the named meshes that no
/// remaining geom uses. If the model has no rangefinders, the physics stay the same byte for byte. Compilation becomes
/// faster, because meshes take most of its time.
///
/// # Errors
/// [`super::Error`] if the text is not XML.
pub(super) fn without_visual_geoms(text: &Text) -> Result<Text> {
    let document = parse("the model", &text.xml)?;
    let attributes = ModelText { document: &document };
    let is_in_tree = |geom: &Node<'_, '_>| geom.ancestors().any(|ancestor| ancestor.has_tag_name("worldbody"));
    let (out, kept): (Vec<_>, Vec<_>) =
        attributes.elements("geom").partition(|geom| is_in_tree(geom) && attributes.is_omitted_from_physics(*geom));
    let meshes = kept.iter().filter_map(|geom| attributes.get(*geom, "mesh")).collect::<Vec<_>>();
    let is_used = |mesh: &Node<'_, '_>| mesh.attribute("name").is_none_or(|name| meshes.contains(&name));
    let unused = attributes.elements("mesh").filter(|mesh| !out.is_empty() && !is_used(mesh));
    let is_single = |node: &Node<'_, '_>| !node.children().any(|child| child.is_element());
    let rows = out.iter().copied().chain(unused).filter(is_single);
    let rows: Vec<u32> = rows.map(|node| document.text_pos_at(node.range().start).row).collect();
    Ok(text.without(&rows))
}
