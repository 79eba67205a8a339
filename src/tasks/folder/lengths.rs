//! Edits of lengths, sizes and positions in the text of a model: which numbers of the text change, and how they follow
//! from the parameters.
//!
//! A body is scaled about the anchor of its first hinge or ball joint, so that it stays attached to its parent. Without
//! such a joint it is scaled about the origin of its frame. The bodies attached to it move with it, but keep their
//! sizes.

use super::{
    attributes::ModelText,
    checks::can_touch,
    error::Result,
    mjcf::{Text, parse, write_attribute},
    parameter::{EditedParameter, ParameterEdit},
    target::{Change, Target},
};
use perturb_mujoco::{Index, Model, ModelField};
use roxmltree::Node;
use std::collections::BTreeMap;

/// A length, size, radius or position of the model that a parameter edits. After such an edit the model must be
/// compiled again.
#[derive(Debug)]
pub(super) struct EditedLength {
    /// The index of the parameter.
    pub(super) parameter: usize,
    edit: ParameterEdit,
    target: Target,
    /// The value in the unedited model.
    own: f64,
}

impl EditedLength {
    /// Collects the edited lengths of all parameters: one [`EditedLength`] for each target that requires a new
    /// compilation.
    pub(super) fn all(parameters: &[EditedParameter], model: &Model) -> Vec<Self> {
        let mut edited_lengths = Vec::new();
        for (parameter, edited) in parameters.iter().enumerate() {
            for edit in &edited.edits {
                let targets = edit.targets.all.iter().filter(|target| target.is_recompiled());
                let edited_length =
                    |&target: &Target| Self { parameter, edit: edit.clone(), target, own: target.value(model) };
                edited_lengths.extend(targets.map(edited_length));
            }
        }
        edited_lengths
    }

    /// Returns by how much the edited length changes with these parameter values: a factor for a length, size or
    /// radius, a shift in m for a position.
    pub(super) fn amount(&self, values: &[f64]) -> f64 {
        let value = values[self.parameter];
        match self.target {
            Target::Position(..) => self.edit.number(self.own, value) - self.own,
            _ if self.edit.change == Change::Scale => value,
            _ => self.edit.number(self.own, value) / self.own,
        }
    }

    /// Returns the amount that changes nothing: 0 for a position, otherwise 1.
    pub(super) fn neutral(&self) -> f64 {
        if matches!(self.target, Target::Position(..)) { 0.0 } else { 1.0 }
    }
}

/// A summand of a number in the text. If `length_index` is `None`, the summand is `coefficient`. Otherwise
/// `length_index` is the index of an [`EditedLength`], and the summand is `coefficient` times
/// [`EditedLength::amount`]. The amount is squared if `squared`.
#[derive(Debug, Clone, Copy)]
struct Summand {
    coefficient: f64,
    length_index: Option<usize>,
    squared: bool,
}

impl Summand {
    fn new(coefficient: f64, length_index: Option<usize>) -> Self {
        Self { coefficient, length_index, squared: false }
    }
}

/// A number in the text: the sum of its parts. If the amounts of all edited lengths in the parts are neutral, the
/// number is exactly `own`, without rounding errors of the sum.
#[derive(Debug)]
struct EditedNumber {
    own: f64,
    parts: Vec<Summand>,
}

impl EditedNumber {
    fn value(&self, edited_lengths: &[EditedLength], amounts: &[f64]) -> f64 {
        let changes =
            |length_index: usize| amounts[length_index].to_bits() != edited_lengths[length_index].neutral().to_bits();
        if !self.parts.iter().filter_map(|part| part.length_index).any(changes) {
            return self.own;
        }
        let value = |&Summand { coefficient, length_index, squared }: &Summand| match length_index
            .map(|length_index| amounts[length_index])
        {
            None => coefficient,
            Some(amount) if squared => coefficient * (amount * amount),
            Some(amount) => coefficient * amount,
        };
        self.parts.iter().map(value).reduce(|sum, part| sum + part).unwrap_or(self.own)
    }
}

/// The name of an attribute, and its numbers.
type Attribute = (&'static str, Vec<EditedNumber>);

#[derive(Debug)]
enum Piece {
    Text(String),
    /// An edited element: the text of its start with the unedited attributes, the edited attributes, and the text of
    /// its end.
    Element(String, Vec<Attribute>, &'static str),
}

/// A model's text whose numbers depend on the amount of each [`EditedLength`].
#[derive(Debug)]
pub(super) struct EditedText {
    pieces: Vec<Piece>,
}

impl EditedText {
    /// Finds the numbers in a text that the edited lengths change. `lacks_visual_geoms` says whether `model` lacks the
    /// geoms that affect only pictures. `refuse` creates an error from the index of an edited length and a reason.
    ///
    /// # Errors
    /// An error of `refuse` if an element does not have the edited length, or cannot follow the edit.
    pub(super) fn new(
        text: &Text,
        model: &Model,
        edited_lengths: &[EditedLength],
        lacks_visual_geoms: bool,
        refuse: &dyn Fn(usize, &str) -> super::error::Error,
    ) -> Result<Self> {
        let document = parse("the model", &text.xml)?;
        let mut editor = Editor {
            attributes: ModelText { document: &document },
            model,
            edited_lengths,
            lacks_visual_geoms,
            refuse,
            edited: BTreeMap::new(),
        };
        editor.edit()?;
        let mut edited = editor.edited;
        let mut pieces = vec![Piece::Text(String::new())];
        for (row, line) in text.xml.lines().enumerate() {
            match (edited.remove(&(row as u32 + 1)), pieces.last_mut()) {
                (None, Some(Piece::Text(text))) => {
                    text.push_str(line);
                    text.push('\n');
                }
                (None, _) => pieces.push(Piece::Text(format!("{line}\n"))),
                (Some((head, numbers)), _) => {
                    let end = if line.ends_with("/>") { "/>\n" } else { ">\n" };
                    pieces.push(Piece::Element(head, numbers, end));
                }
            }
        }
        Ok(Self { pieces })
    }

    /// Returns the MJCF text with edited lengths. `amounts` has the result of [`EditedLength::amount`] for each entry
    /// of `edited_lengths`.
    pub(super) fn write(&self, edited_lengths: &[EditedLength], amounts: &[f64]) -> String {
        let mut text = String::new();
        for piece in &self.pieces {
            match piece {
                Piece::Text(fixed) => text.push_str(fixed),
                Piece::Element(head, attributes, end) => {
                    text.push_str(head);
                    for (key, numbers) in attributes {
                        let numbers = numbers.iter().map(|number| number.value(edited_lengths, amounts).to_string());
                        write_attribute(&mut text, key, &numbers.collect::<Vec<_>>().join(" "));
                    }
                    text.push_str(end);
                }
            }
        }
        text
    }
}

/// The index of the [`EditedLength`] that scales a body, if any.
#[derive(Clone, Copy, Default)]
struct Scaling {
    /// The index of the [`EditedLength`] that scales positions and lengths.
    along: Option<usize>,
    /// The index of the same [`EditedLength`] if it also scales everything else, such as radii.
    size: Option<usize>,
}

/// Collects the edited elements of a text.
struct Editor<'a, 'input> {
    attributes: ModelText<'a, 'input>,
    model: &'a Model,
    edited_lengths: &'a [EditedLength],
    /// Whether `model` lacks the geoms that affect only pictures.
    lacks_visual_geoms: bool,
    refuse: &'a dyn Fn(usize, &str) -> super::error::Error,
    /// The edited elements by their line in the text: the element's start without the edited attributes, and the edited
    /// attributes.
    edited: BTreeMap<u32, (String, Vec<Attribute>)>,
}

impl<'a, 'input> Editor<'a, 'input> {
    fn edit(&mut self) -> Result<()> {
        let bodies: Vec<Node<'a, 'input>> = self.attributes.elements("body").collect();
        if bodies.len() + 1 != self.model.n_body() {
            return Err((self.refuse)(0, "lengths of a model with composites cannot be edited"));
        }
        if self.attributes.compiler("coordinate") == Some("global") {
            return Err((self.refuse)(
                0,
                "lengths need coordinate=\"local\", which newer models have; convert the model",
            ));
        }
        let scalings: Vec<Scaling> = (0..self.model.n_body()).map(|body| self.scaling(body)).collect::<Result<_>>()?;
        self.constraints(&bodies, &scalings)?;
        for (i, &node) in bodies.iter().enumerate() {
            self.frame(node, i + 1, &scalings)?;
        }
        let worlds = self.attributes.elements("worldbody");
        let mut ranks = vec![0; self.model.n_body()];
        for (body, node) in
            worlds.map(|node| (0, node)).chain(bodies.iter().enumerate().map(|(i, &node)| (i + 1, node)))
        {
            self.content(node, body, scalings[body], &mut ranks[body])?;
        }
        Ok(())
    }

    /// Finds the [`EditedLength`] that scales a body. Returns an error if two edited lengths scale the body.
    fn scaling(&self, body: usize) -> Result<Scaling> {
        let mut scaling = Scaling::default();
        for (length_index, EditedLength { target, .. }) in self.edited_lengths.iter().enumerate() {
            let size = match *target {
                Target::Length(of, _) if of == body => None,
                Target::Size(of, _) if of == body => Some(length_index),
                _ => continue,
            };
            if scaling.along.is_some() {
                return Err((self.refuse)(length_index, "another edit scales this body, too; let one edit do it"));
            }
            scaling = Scaling { along: Some(length_index), size };
        }
        Ok(scaling)
    }

    /// Refuses equality constraints that name a scaled body, because the constraints' anchors would not be scaled with
    /// the body.
    fn constraints(&self, bodies: &[Node<'a, 'input>], scalings: &[Scaling]) -> Result<()> {
        for constraint in self.attributes.elements("connect").chain(self.attributes.elements("weld")) {
            for name in ["body1", "body2"].into_iter().filter_map(|key| constraint.attribute(key)) {
                let found = bodies.iter().position(|node| node.attribute("name") == Some(name));
                if let Some(length_index) = found.and_then(|i| scalings[i + 1].along) {
                    let problem =
                        format!("an equality constraint names body {name:?}, and its anchor would not follow");
                    return Err((self.refuse)(length_index, &problem));
                }
            }
        }
        Ok(())
    }

    /// Edits the position of a body's frame. The body's anchor moves with a scaled parent. If the body itself is
    /// scaled, its frame moves relative to the anchor.
    fn frame(&mut self, node: Node<'a, 'input>, body: usize, scalings: &[Scaling]) -> Result<()> {
        let parent = self.model.index_array(Index::BodyParent)[body] as usize;
        let (carried, own) = (scalings[parent].along, scalings[body].along);
        let shift = |axis: usize| {
            let shifts =
                |it: &EditedLength| matches!(it.target, Target::Position(of, along) if (of, along) == (body, axis));
            self.edited_lengths.iter().position(shifts)
        };
        let shifts: [Option<usize>; 3] = std::array::from_fn(shift);
        let anchor = attachment(self.model, body);
        let is_offset = anchor != [0.0; 3];
        let own = own.filter(|_| is_offset);
        if carried.is_none() && own.is_none() && shifts == [None; 3] {
            return Ok(());
        }
        if let Some(length_index) = shifts.into_iter().flatten().next()
            && (carried.is_some() || own.is_some())
        {
            let problem = "a length moves this body, too; edit only one of the two";
            return Err((self.refuse)(length_index, problem));
        }
        let position = self.numbers(node, "pos", &[0.0; 3])?;
        let number = |axis: usize| {
            let mut parts = vec![Summand::new(position[axis] + anchor[axis], carried)];
            parts.extend(shifts[axis].map(|length_index| Summand::new(1.0, Some(length_index))));
            if anchor[axis] != 0.0 {
                parts.push(Summand::new(-anchor[axis], own));
            }
            EditedNumber { own: position[axis], parts }
        };
        self.set(node, "pos", (0..3).map(number).collect());
        Ok(())
    }

    /// Edits the elements inside a body. `rank` counts the geoms of the body that were visited so far, and is updated.
    fn content(&mut self, node: Node<'a, 'input>, body: usize, scaling: Scaling, rank: &mut usize) -> Result<()> {
        let inertial = self.attributes.inertial(node);
        for child in node.children().filter(Node::is_element) {
            match child.tag_name().name() {
                "geom" if self.attributes.is_omitted_from_physics(child) && self.lacks_visual_geoms => {
                    self.scale(child, "pos", &[], scaling.along)?;
                }
                "geom" => {
                    let geom = self.geom_of(body, *rank);
                    *rank += 1;
                    self.geom(child, geom, scaling, inertial.is_some())?;
                }
                "joint" => self.scale(child, "pos", &[], scaling.along)?,
                "site" => {
                    self.scale(child, "pos", &[], scaling.along)?;
                    self.scale(child, "fromto", &[], scaling.along)?;
                    self.scale(child, "size", &[], scaling.size)?;
                }
                _ => {}
            }
        }
        // At constant mass, the inertia that an `<inertial>` element states grows with the square of the size.
        let (Some(inertial), Some(length_index)) = (inertial, scaling.along) else { return Ok(()) };
        if scaling.size.is_none() {
            let problem =
                "the body has <inertial>, whose moments do not follow a length; leave it out, or use field = \"size\"";
            return Err((self.refuse)(length_index, problem));
        }
        self.scale(inertial, "pos", &[], scaling.along)?;
        for key in ["diaginertia", "fullinertia"] {
            let own = self.numbers(inertial, key, &[])?;
            let part = |coefficient: f64| Summand { coefficient, length_index: scaling.size, squared: true };
            let number = |&own: &f64| EditedNumber { own, parts: vec![part(own)] };
            self.set(inertial, key, own.iter().map(number).collect());
        }
        Ok(())
    }

    /// Returns the index in the model of a body's geom number `rank`, counted from 0.
    fn geom_of(&self, body: usize, rank: usize) -> Option<usize> {
        let bodies = self.model.index_array(Index::GeomBody).iter().enumerate();
        bodies.filter(|(_, of)| **of as usize == body).nth(rank).map(|(geom, _)| geom)
    }

    fn geom(
        &mut self,
        node: Node<'a, 'input>,
        geom: Option<usize>,
        Scaling { along, size }: Scaling,
        has_inertial: bool,
    ) -> Result<()> {
        let radius =
            |edited_length: &EditedLength| matches!(edited_length.target, Target::Radius(of) if Some(of) == geom);
        let radius = self.edited_lengths.iter().position(radius);
        if let (Some(_), Some(length_index)) = (radius, size) {
            return Err((self.refuse)(
                length_index,
                "another edit sets the radius of one of its geoms, too; edit only one of the two",
            ));
        }
        let Some(length_index) = along.or(radius) else { return Ok(()) };
        // An edit that affects neither contacts nor the inertia is refused.
        let kind = self.attributes.get(node, "type").unwrap_or("sphere");
        let keeps_inertia = along.is_none() && has_inertial;
        let touches = geom.is_some_and(|geom| can_touch(self.model, geom));
        if keeps_inertia && !touches {
            let problem =
                "it has no effect: one of its geoms can touch nothing, and its body has an <inertial> of its own";
            return Err((self.refuse)(length_index, problem));
        }
        if self.attributes.get(node, "mesh").is_some() || matches!(kind, "mesh" | "hfield" | "plane") {
            if !self.attributes.affects_only_pictures(node) {
                let problem = "a mesh, a height field or a plane cannot be scaled, and one of its geoms is one";
                return Err((self.refuse)(length_index, problem));
            }
            return self.scale(node, "pos", &[], along);
        }
        // Position and length follow `along`. Radii and other sizes follow `size`, or an edit of the radius.
        let has_ends = self.attributes.get(node, "fromto").is_some();
        self.scale(node, if has_ends { "fromto" } else { "pos" }, &[], along)?;
        let wide = size.or(radius);
        match kind {
            "sphere" => self.scale(node, "size", &[wide], None),
            "capsule" | "cylinder" if has_ends => self.scale(node, "size", &[wide], None),
            "capsule" | "cylinder" => self.scale(node, "size", &[wide, along], None),
            _ if size.is_none() => {
                let problem = format!("the body has a {kind}, which has no length; use field = \"size\"");
                Err((self.refuse)(length_index, &problem))
            }
            _ => self.scale(node, "size", &[], size),
        }
    }

    /// Scales the numbers of an attribute. `first` and `rest` are indices of [`EditedLength`]s. The [`EditedLength`]
    /// `first[i]` scales number i. The [`EditedLength`] `rest` scales the numbers beyond the end of `first`. `None`
    /// leaves a number unchanged.
    fn scale(
        &mut self,
        node: Node<'a, 'input>,
        key: &'static str,
        first: &[Option<usize>],
        rest: Option<usize>,
    ) -> Result<()> {
        let length_index = |i: usize| first.get(i).copied().unwrap_or(rest);
        let own = self.numbers(node, key, &[])?;
        if (0..own.len()).all(|i| length_index(i).is_none() || own[i] == 0.0) {
            return Ok(());
        }
        let number = |(i, &own): (usize, &f64)| EditedNumber { own, parts: vec![Summand::new(own, length_index(i))] };
        self.set(node, key, own.iter().enumerate().map(number).collect());
        Ok(())
    }

    /// Returns the numbers of an attribute of an element or of its default class. Returns `absent` if neither has the
    /// attribute.
    fn numbers(&self, node: Node<'a, 'input>, key: &str, absent: &[f64]) -> Result<Vec<f64>> {
        let Some(text) = self.attributes.get(node, key) else { return Ok(absent.to_vec()) };
        let numbers = text.split_whitespace().map(|number| number.parse().ok()).collect::<Option<Vec<f64>>>();
        numbers.ok_or_else(|| (self.refuse)(0, &format!("{key}=\"{text}\" of the model is not a list of numbers")))
    }

    /// Replaces an attribute of an element by edited numbers.
    fn set(&mut self, node: Node<'a, 'input>, key: &'static str, numbers: Vec<EditedNumber>) {
        if numbers.is_empty() {
            return;
        }
        let row = self.attributes.document.text_pos_at(node.range().start).row;
        let (head, attributes) = self.edited.entry(row).or_default();
        attributes.push((key, numbers));
        *head = format!("<{}", node.tag_name().name());
        for attribute in node.attributes().filter(|own| attributes.iter().all(|(edited, _)| *edited != own.name())) {
            write_attribute(head, attribute.name(), attribute.value());
        }
    }
}

/// Returns the vector from the origin of a body's frame to the point at which it is attached, in the axes of its
/// parent. This point is the anchor of the body's first hinge or ball joint, or the origin itself if the body has no
/// such joint.
pub(super) fn attachment(model: &Model, body: usize) -> [f64; 3] {
    let (types, bodies) = (model.index_array(Index::JointType), model.index_array(Index::JointBody));
    let is_own = |&joint: &usize| bodies[joint] as usize == body && matches!(types[joint], 1 | 3);
    let Some(joint) = (0..model.n_joint()).find(is_own) else { return [0.0; 3] };
    let anchor: [f64; 3] = std::array::from_fn(|i| model.field(ModelField::JointAnchor)[3 * joint + i]);
    let rotation = &model.field(ModelField::BodyRotation)[4 * body..][..4];
    if anchor == [0.0; 3] || *rotation == [1.0, 0.0, 0.0, 0.0] {
        return anchor;
    }
    // Rotates the anchor v by the quaternion (w, u): v + 2 w (u × v) + 2 u × (u × v).
    let (w, u) = (rotation[0], [rotation[1], rotation[2], rotation[3]]);
    let cross =
        |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let (once, twice) = (cross(u, anchor), cross(u, cross(u, anchor)));
    std::array::from_fn(|i| anchor[i] + 2.0 * (w * once[i] + twice[i]))
}
