//! Finds modules, `use` items and paths in one Rust file, except in tests.

use crate::lexer::{SourceToken, TokenKind, is_test_attribute, tokens};

/// A module, a `use` item or a path in the file. `inside` are the names of the inline modules around it, outermost
/// first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Item {
    /// `mod name { … }`. The last name of `inside` is the module's own.
    InlineModule { inside: Vec<String> },
    /// `mod name;`. `path` is the value of its attribute `#[path = "…"]`, if there is one.
    Module { inside: Vec<String>, name: String, path: Option<String> },
    /// A name that a `use` item defines; `None` for `*`.
    Use { inside: Vec<String>, name: Option<String>, target: Vec<String>, line: usize },
    /// A path of at least two names in code that is not a `use` item.
    Path { inside: Vec<String>, names: Vec<String>, line: usize },
}

/// Reads all modules, `use` items and paths of a file.
pub(super) fn items(source: &str) -> Vec<Item> {
    let mut scanner = Scanner { tokens: tokens(source), position: 0, items: Vec::new(), depth: 0, inside: Vec::new() };
    scanner.run();
    scanner.items
}

/// The content of the attributes before an item.
#[derive(Default)]
struct Attributes {
    is_test: bool,
    path: Option<String>,
}

struct Scanner {
    tokens: Vec<SourceToken>,
    position: usize,
    items: Vec<Item>,
    /// The number of open braces.
    depth: usize,
    /// The names of the inline modules around the current token, each with the number of open braces in its content.
    inside: Vec<(String, usize)>,
}

impl Scanner {
    fn peek(&self, ahead: usize) -> Option<&SourceToken> {
        self.tokens.get(self.position + ahead)
    }

    fn is_symbol(&self, ahead: usize, symbol: char) -> bool {
        self.peek(ahead).is_some_and(|token| token.is_symbol(symbol))
    }

    fn is_word(&self, ahead: usize, word: &str) -> bool {
        self.peek(ahead).is_some_and(|token| token.is_word(word))
    }

    fn word(&self, ahead: usize) -> Option<String> {
        self.peek(ahead).and_then(SourceToken::word).map(str::to_owned)
    }

    fn inside(&self) -> Vec<String> {
        self.inside.iter().map(|(name, _)| name.clone()).collect()
    }

    fn run(&mut self) {
        let mut attributes = Attributes::default();
        while let Some(token) = self.peek(0) {
            if token.is_symbol('#') && (self.is_symbol(1, '[') || self.is_symbol(1, '!') && self.is_symbol(2, '[')) {
                let is_inner = self.is_symbol(1, '!');
                self.attribute(&mut attributes);
                if is_inner && std::mem::take(&mut attributes).is_test {
                    return;
                }
                continue;
            }
            let attributes = std::mem::take(&mut attributes);
            if attributes.is_test {
                self.skip_item();
            } else if token.is_word("mod") && (self.is_symbol(2, ';') || self.is_symbol(2, '{')) {
                self.module(attributes.path);
            } else if token.is_word("use") {
                self.position += 1;
                self.use_item();
            } else if token.is_symbol('(') && self.is_word(1, "in") {
                // Skips `pub(in path)`: its path only restricts visibility and is not an import.
                self.skip_past(')');
            } else if token.word().is_some() {
                self.path();
            } else {
                match token.kind {
                    TokenKind::Symbol('{') => self.depth += 1,
                    TokenKind::Symbol('}') => {
                        self.depth = self.depth.saturating_sub(1);
                        self.inside.retain(|(_, depth)| *depth <= self.depth);
                    }
                    _ => {}
                }
                self.position += 1;
            }
        }
    }

    /// Reads an attribute. The current token is its `#`.
    fn attribute(&mut self, attributes: &mut Attributes) {
        let start = self.position;
        self.skip_past_matching('[', ']');
        let content = &self.tokens[start..self.position.min(self.tokens.len())];
        let words: Vec<_> = content.iter().filter_map(SourceToken::word).collect();
        attributes.is_test |= match words.first() {
            Some(&"cfg") => words.contains(&"test") && !words.contains(&"not"),
            Some(_) => is_test_attribute(content),
            None => false,
        };
        if words.first() == Some(&"path") {
            attributes.path = content.iter().find_map(|token| match &token.kind {
                TokenKind::Text(text) => Some(text.clone()),
                _ => None,
            });
        }
    }

    /// Skips all tokens up to and including the next `end`.
    fn skip_past(&mut self, end: char) {
        while self.peek(0).is_some_and(|token| !token.is_symbol(end)) {
            self.position += 1;
        }
        self.position += 1;
    }

    /// Skips all tokens up to and including the `close` that matches the next `open`.
    fn skip_past_matching(&mut self, open: char, close: char) {
        let mut depth = 0_usize;
        while let Some(token) = self.peek(0) {
            let opens = token.is_symbol(open);
            let closes = token.is_symbol(close);
            self.position += 1;
            if opens {
                depth += 1;
            } else if closes {
                depth = depth.saturating_sub(1);
                if depth == 0 {
                    return;
                }
            }
        }
    }

    /// Skips the item, statement, field or match arm after a test attribute.
    fn skip_item(&mut self) {
        // A field is `name: type`, possibly after `pub` or `pub(…)`. Unlike an item, a field ends at a comma.
        let is_field = {
            let mut ahead = 0;
            if self.is_word(0, "pub") {
                ahead = if self.is_symbol(1, '(') { 4 } else { 1 };
            }
            self.peek(ahead).is_some_and(|token| token.word().is_some()) && self.is_symbol(ahead + 1, ':')
        };
        let is_item = !is_field
            && self.peek(0).and_then(SourceToken::word).is_some_and(|word| {
                matches!(
                    word,
                    "pub"
                        | "fn"
                        | "mod"
                        | "impl"
                        | "struct"
                        | "enum"
                        | "use"
                        | "const"
                        | "static"
                        | "type"
                        | "trait"
                        | "unsafe"
                        | "async"
                        | "extern"
                        | "macro_rules"
                )
            });
        // The number of brackets that were opened and not yet closed.
        let mut depth = 0_usize;
        while let Some(token) = self.peek(0) {
            match token.kind {
                TokenKind::Symbol('(' | '[' | '{') => depth += 1,
                TokenKind::Symbol(')' | ']' | '}') if depth == 0 => return,
                TokenKind::Symbol('}') if depth == 1 => {
                    self.position += 1;
                    return;
                }
                TokenKind::Symbol(')' | ']' | '}') => depth -= 1,
                TokenKind::Symbol(';') if depth == 0 => {
                    self.position += 1;
                    return;
                }
                TokenKind::Symbol(',') if depth == 0 && !is_item => {
                    self.position += 1;
                    return;
                }
                _ => {}
            }
            self.position += 1;
        }
    }

    /// Reads `mod name;` or the beginning of `mod name { … }`.
    fn module(&mut self, path: Option<String>) {
        let Some(name) = self.word(1) else {
            self.position += 1;
            return;
        };
        if self.is_symbol(2, '{') {
            self.depth += 1;
            self.inside.push((name, self.depth));
            self.items.push(Item::InlineModule { inside: self.inside() });
        } else {
            self.items.push(Item::Module { inside: self.inside(), name, path });
        }
        self.position += 3;
    }

    /// Reads a `use` item after its keyword.
    fn use_item(&mut self) {
        if self.peek(0).is_some_and(|token| token.kind == TokenKind::PathSeparator) {
            // `use ::name` imports from another crate.
            self.skip_past(';');
            return;
        }
        self.use_tree(&[]);
        self.skip_past(';');
    }

    /// Reads one tree of a `use` item: a path, followed by nothing, `as name`, `*` or a group of trees.
    fn use_tree(&mut self, prefix: &[String]) {
        let mut target = prefix.to_vec();
        let line = self.peek(0).map_or(0, |token| token.line);
        loop {
            if self.is_symbol(0, '{') {
                self.position += 1;
                while self.peek(0).is_some() && !self.is_symbol(0, '}') {
                    self.use_tree(&target);
                    if self.is_symbol(0, ',') {
                        self.position += 1;
                    }
                }
                self.position += 1;
                return;
            }
            if self.is_symbol(0, '*') {
                self.position += 1;
                self.items.push(Item::Use { inside: self.inside(), name: None, target, line });
                return;
            }
            let Some(word) = self.word(0) else {
                // Skips a token that cannot be part of a `use` item.
                self.position += 1;
                return;
            };
            self.position += 1;
            target.push(word);
            if self.peek(0).is_some_and(|token| token.kind == TokenKind::PathSeparator) {
                self.position += 1;
                continue;
            }
            if target.len() > 1 && target.last().is_some_and(|name| name == "self") {
                target.pop();
            }
            let mut name = target.last().cloned();
            if self.is_word(0, "as") {
                name = self.word(1);
                self.position += 2;
            }
            self.items.push(Item::Use { inside: self.inside(), name, target, line });
            return;
        }
    }

    /// Reads a path outside of `use` items. A path with a single name is ignored, because it does not name a module.
    fn path(&mut self) {
        let line = self.peek(0).map_or(0, |token| token.line);
        let follows = self.position > 0
            && (self.tokens[self.position - 1].kind == TokenKind::PathSeparator
                || self.tokens[self.position - 1].is_symbol('.') && !self.is_range(self.position - 1));
        let mut names = Vec::new();
        while let Some(word) = self.word(0) {
            names.push(word);
            self.position += 1;
            let goes_on = self.peek(0).is_some_and(|token| token.kind == TokenKind::PathSeparator)
                && self.peek(1).is_some_and(|token| token.word().is_some());
            if !goes_on {
                break;
            }
            self.position += 1;
        }
        if names.len() > 1 && !follows {
            self.items.push(Item::Path { inside: self.inside(), names, line });
        }
    }

    /// Returns whether the `.` at `position` is the second `.` of `..`.
    fn is_range(&self, position: usize) -> bool {
        position > 0 && self.tokens[position - 1].is_symbol('.')
    }
}
