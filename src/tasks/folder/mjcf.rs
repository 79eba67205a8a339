//! Reads the MJCF model of a folder. This module resolves includes, and reads only files inside the folder. MuJoCo gets
//! a rewritten text and the contents of the files, so it reads nothing from the disk.
//!
//! There are two texts. The text for pictures has everything. The text for the physics lacks textures, materials, skins
//! and `<visual>`, which would cost memory in every simulation and do not affect the physics.

use super::{
    error::{Error, Result, escaped},
    files::Files,
    table::decode,
};
use roxmltree::{Document, Node, ParsingOptions};
use std::{collections::BTreeMap, fmt::Write};

/// Maximal nesting depth of elements. The limit bounds the recursion of MuJoCo and of this module.
const MAX_DEPTH: usize = 200;
/// Maximal number of XML nodes in one file: elements, texts and comments. Attributes do not count.
const MAX_NODES: u32 = 2_000_000;
/// Maximal number of elements of a composite. Nearly every element has at least one degree of freedom, so a larger
/// composite would exceed the limit of degrees of freedom anyway, but only after minutes of compilation.
const MAX_COMPOSITE_ELEMENTS: f64 = 10_000.0;
/// Attributes that refer to files: the element, its attributes, and whether the physics needs the file.
const FILE_ATTRIBUTES: [(&str, &[&str], bool); 4] = [
    ("mesh", &["file"], true),
    ("hfield", &["file"], true),
    ("texture", &["file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback"], false),
    ("skin", &["file"], false),
];

/// The MJCF texts of a model, for the physics and for pictures, and some of the model's properties.
#[derive(Debug)]
pub(super) struct Mjcf {
    /// The text for the physics.
    pub(super) physics: Text,
    /// The text for pictures.
    pub(super) picture: Text,
    /// The names of the attributes of `<statistic>` in the model.
    pub(super) statistic: Vec<String>,
    /// Whether the model has `settotalmass`, which scales all masses to a total.
    pub(super) has_total_mass: bool,
    /// Whether the text for the physics lacks the geoms that affect only pictures.
    pub(super) lacks_visual_geoms: bool,
}

/// An MJCF text with one element per line, and the files to which it refers.
#[derive(Debug, Default)]
pub(super) struct Text {
    pub(super) xml: String,
    /// The names and contents of the files, for [`perturb_mujoco::Model::from_files`].
    pub(super) files: Vec<(String, Vec<u8>)>,
    /// For each line of the text, the original file (an index in `sources`) and line.
    lines: Vec<(usize, u32)>,
    /// The names of the original files.
    sources: Vec<String>,
}

impl Text {
    /// Returns the original file and line of a line of the text. Lines count from 1.
    pub(super) fn source(&self, line: usize) -> Option<(&str, u32)> {
        let (file, line) = *self.lines.get(line.checked_sub(1)?)?;
        Some((self.sources.get(file)?, line))
    }

    /// Returns the text without the lines `rows`, which count from 1.
    pub(super) fn without(&self, rows: &[u32]) -> Self {
        let mut kept =
            Self { xml: String::new(), files: self.files.clone(), lines: Vec::new(), sources: self.sources.clone() };
        let lines = self.xml.lines().zip(&self.lines).enumerate();
        for (_, (line, &source)) in lines.filter(|(i, _)| !rows.contains(&(*i as u32 + 1))) {
            kept.push(line, source);
        }
        kept
    }

    fn push(&mut self, element: &str, (file, line): (usize, u32)) {
        self.xml.push_str(element);
        self.xml.push('\n');
        self.lines.push((file, line));
    }

    /// Adds a file of the folder, if it is not `known` yet. Returns the name by which the text refers to it.
    fn add_file(&mut self, path: &str, bytes: &[u8], known: &mut BTreeMap<String, String>) -> String {
        if let Some(name) = known.get(path) {
            return name.clone();
        }
        let extension: String = path.rsplit_once('.').map_or("", |(_, extension)| extension).chars().take(8).collect();
        let extension: String = extension.to_lowercase().chars().filter(char::is_ascii_alphanumeric).collect();
        let name = format!("file{}.{extension}", self.files.len());
        known.insert(path.to_owned(), name.clone());
        self.files.push((name.clone(), bytes.to_vec()));
        name
    }
}

/// Reads the model file `main` of a folder and its includes, and writes the texts for MuJoCo.
///
/// # Errors
/// [`Error`] with the file and the line.
pub(super) fn read(files: &mut Files, main: &str) -> Result<Mjcf> {
    let mut sources = Vec::new();
    collect(files, main, "task.toml", &mut sources)?;
    let documents = sources.iter().map(|(name, text)| parse(name, text)).collect::<Result<Vec<_>>>()?;
    let root = documents[0].root_element();
    check_root(&sources[0].0, &root)?;
    let source_files: Vec<SourceFile<'_>> = sources
        .iter()
        .zip(&documents)
        .map(|((name, text), document)| SourceFile { name, document, line_ends: line_ends(text) })
        .collect();
    let folders = Folders::find(&source_files);
    let attributes = |element: &str| {
        let all = documents.iter().flat_map(|document| document.descendants());
        let found =
            all.filter(|node| node.has_tag_name(element)).flat_map(|node| node.attributes().collect::<Vec<_>>());
        found.map(|attribute| attribute.name().to_owned()).collect::<Vec<_>>()
    };
    let (statistic, compiler) = (attributes("statistic"), attributes("compiler"));
    let mut writer = Writer {
        files,
        source_files: &source_files,
        folders,
        physics: Text::default(),
        picture: Text::default(),
        physics_names: BTreeMap::new(),
        picture_names: BTreeMap::new(),
    };
    writer.physics.sources = source_files.iter().map(|source| source.name.to_owned()).collect();
    writer.picture.sources.clone_from(&writer.physics.sources);
    writer.element(0, root, TextTarget::Both, 0)?;
    let Writer { physics, picture, .. } = writer;
    let has_total_mass = compiler.iter().any(|name| name == "settotalmass");
    Ok(Mjcf { physics, picture, statistic, has_total_mass, lacks_visual_geoms: false })
}

/// Reads a model file and all files that it includes, and appends their names and texts to `sources`. `who` is the name
/// of the file that refers to this file, for error messages.
fn collect(files: &mut Files, path: &str, who: &str, sources: &mut Vec<(String, String)>) -> Result<()> {
    let text = decode(path, files.read(path, who)?)?.to_owned();
    let included: Vec<String> = {
        let document = parse(path, &text)?;
        let included = document.descendants().filter(|node| node.has_tag_name("include"));
        let file = |node: Node<'_, '_>| {
            let name = node.attribute("file").map(|file| file.replace('\\', "/"));
            name.ok_or_else(|| at(path, &node, "<include> has no file; give file=\"name.xml\""))
        };
        included.map(file).collect::<Result<_>>()?
    };
    sources.push((path.to_owned(), text));
    for file in included {
        if sources.iter().any(|(name, _)| *name == file) {
            return Err(Error::file(path, format_args!("{} is included twice; include it once", escaped(&file))));
        }
        collect(files, &file, path, sources)?;
    }
    Ok(())
}

/// Parses a model file. Refuses document type definitions, and files with too many or too deeply nested elements.
pub(super) fn parse<'a>(name: &str, text: &'a str) -> Result<Document<'a>> {
    let options = ParsingOptions { allow_dtd: false, nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options).map_err(|error| {
        let line = error.pos().row as usize;
        Error::line(name, line, format_args!("this is not XML: {}", escaped(&error.to_string())))
    })?;
    let mut depth = vec![(document.root_element(), 0)];
    while let Some((node, level)) = depth.pop() {
        if level > MAX_DEPTH {
            return Err(at(name, &node, format_args!("elements are nested more than {MAX_DEPTH} deep")));
        }
        depth.extend(node.children().filter(Node::is_element).map(|child| (child, level + 1)));
    }
    Ok(document)
}

/// Creates an error about an element, with its line.
fn at(name: &str, node: &Node<'_, '_>, problem: impl std::fmt::Display) -> Error {
    let line = node.document().text_pos_at(node.range().start).row;
    Error::line(name, line as usize, problem)
}

fn check_root(name: &str, root: &Node<'_, '_>) -> Result<()> {
    match root.tag_name().name() {
        "mujoco" => Ok(()),
        "robot" => {
            Err(at(name, root, "this is URDF; convert it to MJCF, for instance with MuJoCo's program `compile`"))
        }
        other => Err(at(name, root, format_args!("the element is <{}>; expected <mujoco>", escaped(other)))),
    }
}

/// Refuses a composite with more than [`MAX_COMPOSITE_ELEMENTS`] elements, because its compilation would take minutes.
fn check_composite(name: &str, node: &Node<'_, '_>) -> Result<()> {
    let count = node.attribute("count").unwrap_or_default();
    // Counts that are not numbers are refused by MuJoCo itself.
    let elements: f64 = count.split_whitespace().filter_map(|number| number.parse::<f64>().ok()).product();
    if elements <= MAX_COMPOSITE_ELEMENTS {
        return Ok(());
    }
    let problem = format_args!("this composite has {elements} elements; give at most {MAX_COMPOSITE_ELEMENTS}");
    Err(at(name, node, problem))
}

/// A parsed file of the model.
struct SourceFile<'a> {
    name: &'a str,
    document: &'a Document<'a>,
    /// The byte offsets of the line ends.
    line_ends: Vec<usize>,
}

impl SourceFile<'_> {
    /// Returns the line of an element, counted from 1.
    fn line(&self, node: &Node<'_, '_>) -> u32 {
        1 + self.line_ends.partition_point(|&end| end < node.range().start) as u32
    }
}

fn line_ends(text: &str) -> Vec<usize> {
    text.bytes().enumerate().filter(|&(_, byte)| byte == b'\n').map(|(offset, _)| offset).collect()
}

/// The subfolders in which MuJoCo looks for files. If several `<compiler>` elements set the same subfolder, the last
/// one counts, as in MuJoCo.
#[derive(Default)]
struct Folders {
    mesh: String,
    texture: String,
    strip_path: bool,
}

impl Folders {
    fn find(source_files: &[SourceFile<'_>]) -> Self {
        let mut folders = Self::default();
        let elements = source_files.iter().flat_map(|source| source.document.descendants());
        for compiler in elements.filter(|node| node.has_tag_name("compiler")) {
            if let Some(folder) = compiler.attribute("meshdir") {
                folders.mesh = folder.to_owned();
            }
            if let Some(folder) = compiler.attribute("texturedir") {
                folders.texture = folder.to_owned();
            }
            if let Some(strip) = compiler.attribute("strippath") {
                folders.strip_path = strip == "true";
            }
        }
        folders
    }

    /// Returns the path, within the task's folder, of a file to which an element refers.
    fn path(&self, element: &str, file: &str) -> String {
        let file = file.replace('\\', "/");
        let name = if self.strip_path { file.rsplit('/').next().unwrap_or_default() } else { &file };
        let folder = if element == "texture" { &self.texture } else { &self.mesh };
        match folder.trim_end_matches(['/', '\\']) {
            "" => name.to_owned(),
            folder => format!("{}/{name}", folder.replace('\\', "/")),
        }
    }
}

/// The texts that an element is written to.
#[derive(Clone, Copy, PartialEq)]
enum TextTarget {
    Both,
    PictureOnly,
}

/// Writes the text for the physics and the text for pictures.
struct Writer<'a> {
    files: &'a mut Files,
    source_files: &'a [SourceFile<'a>],
    folders: Folders,
    physics: Text,
    picture: Text,
    /// The names that the text for the physics gives to files. The key is the file's path in the folder.
    physics_names: BTreeMap<String, String>,
    /// The names that the text for pictures gives to files. The key is the file's path in the folder.
    picture_names: BTreeMap<String, String>,
}

impl Writer<'_> {
    fn element(&mut self, file_index: usize, node: Node<'_, '_>, target: TextTarget, depth: usize) -> Result<()> {
        let (name, tag) = (self.source_files[file_index].name, node.tag_name().name());
        if depth > MAX_DEPTH {
            return Err(at(name, &node, format_args!("elements are nested more than {MAX_DEPTH} deep")));
        }
        if tag == "include" {
            return self.include(node, target, depth);
        }
        if tag == "composite" {
            check_composite(name, &node)?;
        }
        let target = if is_visual(&node) { TextTarget::PictureOnly } else { target };
        let (mut physics, mut picture) = (format!("<{tag}"), format!("<{tag}"));
        for attribute in node.attributes() {
            let key = attribute.name();
            if tag == "compiler" && ["meshdir", "texturedir", "strippath"].contains(&key) {
                continue;
            }
            let (value, picture_value) = match file_reference(tag, key) {
                Some(needed) => {
                    self.file(file_index, &node, attribute.value(), needed && target == TextTarget::Both)?
                }
                None => (attribute.value().to_owned(), attribute.value().to_owned()),
            };
            if key != "material" {
                write_attribute(&mut physics, key, &value);
            }
            write_attribute(&mut picture, key, &picture_value);
        }
        // MuJoCo names an element without a name after its file. The text refers to files by new names, so the
        // element's original name is added.
        if let Some(file) = node.attribute("file").filter(|_| file_reference(tag, "file").is_some())
            && !node.has_attribute("name")
            && !in_defaults(&node)
        {
            let stem = file.rsplit(['/', '\\']).next().unwrap_or_default();
            let stem = stem.rsplit_once('.').map_or(stem, |(stem, _)| stem);
            write_attribute(&mut physics, "name", stem);
            write_attribute(&mut picture, "name", stem);
        }
        let place = (file_index, self.source_files[file_index].line(&node));
        let children: Vec<Node<'_, '_>> = node.children().filter(Node::is_element).collect();
        let end = if children.is_empty() { "/>" } else { ">" };
        if target == TextTarget::Both {
            self.physics.push(&format!("{physics}{end}"), place);
        }
        self.picture.push(&format!("{picture}{end}"), place);
        for &child in &children {
            self.element(file_index, child, target, depth + 1)?;
        }
        if !children.is_empty() {
            if target == TextTarget::Both {
                self.physics.push(&format!("</{tag}>"), place);
            }
            self.picture.push(&format!("</{tag}>"), place);
        }
        Ok(())
    }

    /// Writes the elements of an included file instead of the `<include>` element.
    fn include(&mut self, node: Node<'_, '_>, target: TextTarget, depth: usize) -> Result<()> {
        let file = node.attribute("file").unwrap_or_default().replace('\\', "/");
        let source_files = self.source_files;
        let Some(file_index) = source_files.iter().position(|source| source.name == file) else { return Ok(()) };
        for child in source_files[file_index].document.root_element().children().filter(Node::is_element) {
            self.element(file_index, child, target, depth + 1)?;
        }
        Ok(())
    }

    /// Reads a file to which an element refers. Returns its name in the text for the physics and in the text for
    /// pictures. Files that only pictures need are read, too, because the hash of the task covers them.
    fn file(&mut self, file_index: usize, node: &Node<'_, '_>, value: &str, needed: bool) -> Result<(String, String)> {
        let source = &self.source_files[file_index];
        let path = self.folders.path(node.tag_name().name(), value);
        let who = format!("{}, line {}", escaped(source.name), source.line(node));
        let bytes = self.files.read(&path, &who)?;
        let picture = self.picture.add_file(&path, bytes, &mut self.picture_names);
        let physics =
            if needed { self.physics.add_file(&path, bytes, &mut self.physics_names) } else { picture.clone() };
        Ok((physics, picture))
    }
}

/// Returns whether the physics needs the file to which an attribute refers; `None` if the attribute does not refer to a
/// file.
fn file_reference(tag: &str, key: &str) -> Option<bool> {
    FILE_ATTRIBUTES.iter().find(|(element, keys, _)| *element == tag && keys.contains(&key)).map(|entry| entry.2)
}

/// Whether an element affects only pictures.
fn is_visual(node: &Node<'_, '_>) -> bool {
    match node.tag_name().name() {
        "visual" | "texture" | "material" => true,
        // The skin of a composite is not an asset, and stays in the description of the composite.
        "skin" => node.parent().is_some_and(|parent| parent.has_tag_name("asset")),
        _ => false,
    }
}

fn in_defaults(node: &Node<'_, '_>) -> bool {
    node.ancestors().any(|ancestor| ancestor.has_tag_name("default"))
}

pub(super) fn write_attribute(element: &mut String, key: &str, value: &str) {
    let _ = write!(element, " {key}=\""); // writing to a String cannot fail
    for character in value.chars() {
        match character {
            '&' => element.push_str("&amp;"),
            '<' => element.push_str("&lt;"),
            '>' => element.push_str("&gt;"),
            '"' => element.push_str("&quot;"),
            '\n' | '\r' | '\t' => element.push(' '),
            other => element.push(other),
        }
    }
    element.push('"');
}

/// Converts MuJoCo's error about a text to an error with the user's file and line. Adds a hint if the text uses a
/// keyword of a newer MuJoCo.
pub(super) fn explain(text: &Text, main: &str, reason: &str) -> Error {
    let said = escaped_reason(reason);
    let line = reason.split("line ").nth(1).and_then(|rest| {
        let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
        digits.parse::<usize>().ok()
    });
    let hint = HINTS.iter().find(|(word, _)| reason.contains(&format!("'{word}'")));
    let hint = hint.map_or_else(String::new, |(word, hint)| {
        format!("; {word} came with a newer MuJoCo than this server's, 2.2.2: {hint}")
    });
    let problem = format!("MuJoCo 2.2.2 says: {said}{hint}");
    match line.and_then(|line| text.source(line)) {
        Some((file, line)) => Error::line(file, line as usize, problem),
        None => Error::file(main, problem),
    }
}

/// Returns MuJoCo's message without line and column, which would refer to the rewritten text. Escapes control
/// characters.
pub(super) fn escaped_reason(reason: &str) -> String {
    let cut = reason.find(", line ").unwrap_or(reason.len());
    let words: String = reason[..cut].chars().flat_map(char::escape_debug).collect();
    words.replace("\\'", "'").replace("\\\"", "\"").trim().to_owned()
}

/// MJCF keywords of newer MuJoCo versions, each with an alternative for MuJoCo 2.2.2.
const HINTS: [(&str, &str); 14] = [
    ("actuatorfrcrange", "limit the actuator's force by its forcerange"),
    ("actuatorfrclimited", "limit the actuator's force by its forcerange"),
    ("implicitfast", "use integrator=\"implicit\""),
    ("nativeccd", "leave the flag out"),
    ("multiccd", "leave the flag out"),
    ("gravcomp", "leave it out, or cancel the gravity of the body by a force of your own"),
    ("memory", "use nstack, njmax and nconmax"),
    ("assetdir", "use meshdir and texturedir"),
    ("resolution", "leave it out; requests for pictures say their size"),
    ("distance", "use a rangefinder, or the positions of two sites"),
    ("adhesion", "use another actuator"),
    ("dampratio", "compute kv from it"),
    ("timeconst", "use dyntype=\"filter\" of a general actuator"),
    ("inheritrange", "give ctrlrange"),
];
