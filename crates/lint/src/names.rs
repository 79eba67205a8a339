//! Checks of names: types with two definitions, superlative constants, constructors called `of`, and long test names.

use std::collections::BTreeMap;

use crate::lexer::{SourceToken, TokenKind, is_test_attribute, tokens};
use crate::source::{SourceTree, is_benchmark_or_example, is_generated, is_test};

/// Maximum length of a test's name, in characters.
pub const MAX_TEST_NAME: usize = 60;

/// First words of constants that should have a standard name instead: `MAX_*`, `MIN_*`, `*_TIMEOUT` or `*_INTERVAL`.
pub const SUPERLATIVES: [&str; 12] =
    ["MOST", "LEAST", "LONGEST", "SHORTEST", "GREATEST", "FEW", "MANY", "TINY", "LITTLE", "REST", "LOOK", "AGAIN"];

/// A name with the location of its definition.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Definition {
    /// The defined name.
    pub name: String,
    /// The file with the definition.
    pub file: String,
    /// The line in the file, from 1.
    pub line: usize,
}

/// All names that the checks need.
#[derive(Clone, Debug, Default)]
pub struct NameDefinitions {
    /// Structs, enums, traits, classes and type aliases of modules, except in tests, benchmarks and examples.
    pub types: Vec<Definition>,
    /// The Rust types among `types` that are `pub`. Types that are `pub(crate)` are left out.
    pub public_types: Vec<Definition>,
    /// Constants and statics whose first word is one of [`SUPERLATIVES`], except in tests.
    pub superlatives: Vec<Definition>,
    /// Functions called `of`, except in tests.
    pub called_of: Vec<Definition>,
    /// Test functions whose names have more than [`MAX_TEST_NAME`] characters.
    pub long_tests: Vec<Definition>,
}

/// Reads the names in all Rust and Python files, except generated ones.
pub fn read(tree: &SourceTree) -> NameDefinitions {
    let mut names = NameDefinitions::default();
    for (file, source) in tree.with_extension(".rs").filter(|(path, _)| !is_generated(path)) {
        read_rust(file, source, &mut names);
    }
    for (file, source) in tree.with_extension(".py") {
        read_python(file, source, &mut names);
    }
    names
}

/// Returns the type names that are defined in more than one file of the same language, each with all its definitions.
///
/// Rust and Python types may have the same name, because a class often corresponds to a struct.
pub fn defined_twice(types: &[Definition]) -> BTreeMap<&str, Vec<&Definition>> {
    let mut by_name: BTreeMap<(&str, bool), Vec<&Definition>> = BTreeMap::new();
    for definition in types {
        by_name.entry((&definition.name, definition.file.ends_with(".py"))).or_default().push(definition);
    }
    by_name.retain(|_, definitions| definitions.iter().any(|definition| definition.file != definitions[0].file));
    let mut twice: BTreeMap<&str, Vec<&Definition>> = BTreeMap::new();
    for ((name, _), definitions) in by_name {
        twice.entry(name).or_default().extend(definitions);
    }
    twice
}

fn is_superlative(name: &str) -> bool {
    name.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
        && name.split('_').next().is_some_and(|first| SUPERLATIVES.contains(&first))
}

fn read_rust(file: &str, source: &str, names: &mut NameDefinitions) {
    let tokens = tokens(source);
    let is_test_code = is_test(file);
    let mut is_test_function = false;
    // For each open brace, whether it contains the items of a module.
    let mut braces: Vec<bool> = Vec::new();
    // The number of open braces around the current test module, if there is one.
    let mut test_module = None;
    let mut opens_module = false;
    let mut position = 0;
    while position < tokens.len() {
        let token = &tokens[position];
        let next = tokens.get(position + 1).and_then(SourceToken::word);
        let define = |name: &str| Definition { name: name.to_owned(), file: file.to_owned(), line: token.line };
        match &token.kind {
            TokenKind::Symbol('#') => {
                let content = attribute(&tokens[position..]);
                is_test_function |= is_test_attribute(content);
                let words: Vec<_> = content.iter().filter_map(SourceToken::word).collect();
                if words == ["cfg", "test"]
                    && tokens.get(position + content.len()).is_some_and(|token| token.is_word("mod"))
                {
                    test_module.get_or_insert(braces.len());
                }
                position += content.len().max(1);
                continue;
            }
            TokenKind::Symbol('{') => {
                braces.push(opens_module);
                opens_module = false;
            }
            TokenKind::Symbol('}') => {
                braces.pop();
            }
            TokenKind::Symbol(';') => opens_module = false,
            TokenKind::Word(word) => match (word.as_str(), next) {
                ("mod", Some(_)) => opens_module = true,
                ("fn", Some(name)) => {
                    if is_test_function && name.chars().count() > MAX_TEST_NAME {
                        names.long_tests.push(define(name));
                    }
                    if name == "of" && !is_test_code && test_module.is_none() {
                        names.called_of.push(define(name));
                    }
                    is_test_function = false;
                }
                ("struct" | "enum" | "trait" | "type", Some(name))
                    if braces.iter().all(|is_module| *is_module)
                        && !is_test_code
                        && test_module.is_none()
                        && !is_benchmark_or_example(file) =>
                {
                    names.types.push(define(name));
                    if position > 0 && tokens[position - 1].is_word("pub") {
                        names.public_types.push(define(name));
                    }
                }
                ("const" | "static", Some(name)) if is_superlative(name) && !is_test_code && test_module.is_none() => {
                    names.superlatives.push(define(name));
                }
                _ => {}
            },
            _ => {}
        }
        if (token.is_symbol('}') || token.is_symbol(';')) && test_module == Some(braces.len()) {
            test_module = None;
        }
        position += 1;
    }
}

/// Returns the tokens of an attribute, from `#` to `]`. If the `#` does not start an attribute, returns only the `#`.
fn attribute(tokens: &[SourceToken]) -> &[SourceToken] {
    let mut depth = 0;
    for (index, token) in tokens.iter().enumerate() {
        match token.kind {
            TokenKind::Symbol('[') => depth += 1,
            TokenKind::Symbol(']') if depth == 1 => return &tokens[..=index],
            TokenKind::Symbol(']') => depth -= 1,
            TokenKind::Symbol('#' | '!') if depth == 0 && index < 2 => {}
            _ if depth == 0 => return &tokens[..1],
            _ => {}
        }
    }
    &tokens[..1]
}

fn read_python(file: &str, source: &str, names: &mut NameDefinitions) {
    for (index, line) in source.lines().enumerate() {
        let define = |name: &str| Definition { name: name.to_owned(), file: file.to_owned(), line: index + 1 };
        let start = line.trim_start();
        if let Some(name) = start.strip_prefix("def ").or_else(|| start.strip_prefix("async def ")).map(first_word) {
            if name.starts_with("test_") && name.chars().count() > MAX_TEST_NAME {
                names.long_tests.push(define(name));
            }
            if name == "of" && !is_test(file) {
                names.called_of.push(define(name));
            }
        }
        let constant = first_word(line);
        let after = line[constant.len()..].trim_start();
        if (after.starts_with('=') || after.starts_with(':')) && is_superlative(constant) && !is_test(file) {
            names.superlatives.push(define(constant));
        }
        if let Some(name) =
            line.strip_prefix("class ").map(first_word).filter(|_| !is_test(file) && !is_benchmark_or_example(file))
        {
            names.types.push(define(name));
        }
    }
}

/// Returns the identifier at the start of `text`.
fn first_word(text: &str) -> &str {
    text.split(|c: char| !(c.is_alphanumeric() || c == '_')).next().unwrap_or_default()
}
