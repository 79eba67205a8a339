//! A lexer for Rust. It divides source text into tokens, so that the checks do not mistake comments and strings for
//! code.

/// A token with the line where it starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceToken {
    /// The kind and the content of the token.
    pub kind: TokenKind,
    /// The line in the file, from 1.
    pub line: usize,
}

/// The kind and the content of a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenKind {
    /// An identifier, a keyword or a number, without a prefix `r#` and without the `$` of `$crate`.
    Word(String),
    /// The content of a string literal. Escape sequences are not decoded.
    Text(String),
    /// `::`
    PathSeparator,
    /// Any other character.
    Symbol(char),
}

impl SourceToken {
    /// Returns whether the token is the identifier or keyword `word`.
    pub fn is_word(&self, word: &str) -> bool {
        matches!(&self.kind, TokenKind::Word(found) if found == word)
    }

    /// Returns whether the token is the character `symbol`.
    pub fn is_symbol(&self, symbol: char) -> bool {
        self.kind == TokenKind::Symbol(symbol)
    }

    /// Returns the token's text if it is an identifier, a keyword or a number.
    pub fn word(&self) -> Option<&str> {
        match &self.kind {
            TokenKind::Word(word) => Some(word),
            _ => None,
        }
    }
}

/// Divides Rust source into tokens. Skips comments, character literals and lifetimes.
pub fn tokens(source: &str) -> Vec<SourceToken> {
    Lexer { chars: source.chars().collect(), position: 0, line: 1, tokens: Vec::new() }.run()
}

/// Returns whether an attribute marks a test function: `test`, `rstest`, or a path that ends in one of them.
pub fn is_test_attribute(content: &[SourceToken]) -> bool {
    let mut name = None;
    for token in content.iter().skip_while(|token| token.word().is_none()) {
        match &token.kind {
            TokenKind::Word(word) => name = Some(word.as_str()),
            TokenKind::PathSeparator => {}
            _ => break,
        }
    }
    matches!(name, Some("test" | "rstest"))
}

struct Lexer {
    chars: Vec<char>,
    position: usize,
    line: usize,
    tokens: Vec<SourceToken>,
}

impl Lexer {
    fn run(mut self) -> Vec<SourceToken> {
        while let Some(c) = self.peek(0) {
            if c.is_whitespace() {
                self.advance();
            } else if c == '/' && self.peek(1) == Some('/') {
                while self.peek(0).is_some_and(|c| c != '\n') {
                    self.advance();
                }
            } else if c == '/' && self.peek(1) == Some('*') {
                self.block_comment();
            } else if c == '"' {
                self.string();
            } else if c == '\'' {
                self.quote();
            } else if c.is_alphanumeric() || c == '_' {
                self.word();
            } else if c == '$' && self.starts_with("$crate") {
                self.advance();
            } else if c == ':' && self.peek(1) == Some(':') {
                self.push(TokenKind::PathSeparator);
                self.advance();
                self.advance();
            } else {
                self.push(TokenKind::Symbol(c));
                self.advance();
            }
        }
        self.tokens
    }

    fn peek(&self, ahead: usize) -> Option<char> {
        self.chars.get(self.position + ahead).copied()
    }

    fn starts_with(&self, text: &str) -> bool {
        text.chars().enumerate().all(|(index, c)| self.peek(index) == Some(c))
    }

    fn advance(&mut self) {
        if self.peek(0) == Some('\n') {
            self.line += 1;
        }
        self.position += 1;
    }

    fn push(&mut self, kind: TokenKind) {
        self.tokens.push(SourceToken { kind, line: self.line });
    }

    /// Skips a block comment. Block comments can be nested in Rust.
    fn block_comment(&mut self) {
        let mut depth = 0;
        while self.peek(0).is_some() {
            if self.starts_with("/*") {
                depth += 1;
                self.advance();
            } else if self.starts_with("*/") {
                depth -= 1;
                self.advance();
            }
            self.advance();
            if depth == 0 {
                break;
            }
        }
    }

    /// Reads a string literal with escape sequences.
    fn string(&mut self) {
        let line = self.line;
        self.advance();
        let mut text = String::new();
        while let Some(c) = self.peek(0) {
            self.advance();
            match c {
                '"' => break,
                '\\' => {
                    text.push(c);
                    text.extend(self.peek(0));
                    self.advance();
                }
                c => text.push(c),
            }
        }
        self.tokens.push(SourceToken { kind: TokenKind::Text(text), line });
    }

    /// Reads a raw string. The current character is its first `#` or its `"`.
    fn raw_string(&mut self) {
        let line = self.line;
        let mut end = String::from("\"");
        while self.peek(0) == Some('#') {
            end.push('#');
            self.advance();
        }
        self.advance();
        let mut text = String::new();
        while let Some(c) = self.peek(0) {
            if self.starts_with(&end) {
                self.position += end.len();
                break;
            }
            text.push(c);
            self.advance();
        }
        self.tokens.push(SourceToken { kind: TokenKind::Text(text), line });
    }

    /// Skips a character literal or a lifetime.
    fn quote(&mut self) {
        self.advance();
        if self.peek(0) == Some('\\') {
            self.advance();
            self.advance();
            while self.peek(0).is_some_and(|c| c != '\'') {
                self.advance();
            }
            self.advance();
        } else if self.peek(1) == Some('\'') {
            self.advance();
            self.advance();
        } else {
            while self.peek(0).is_some_and(|c| c.is_alphanumeric() || c == '_') {
                self.advance();
            }
        }
    }

    /// Reads an identifier, a keyword or a number. If the word is the prefix of a string literal, such as `r` or `b`,
    /// reads the string instead.
    fn word(&mut self) {
        let start = self.position;
        while self.peek(0).is_some_and(|c| c.is_alphanumeric() || c == '_') {
            self.advance();
        }
        let word: String = self.chars[start..self.position].iter().collect();
        match (word.as_str(), self.peek(0)) {
            ("r" | "br" | "cr", Some('"')) => self.raw_string(),
            ("r" | "br" | "cr", Some('#')) if self.raw_string_follows() => self.raw_string(),
            ("r", Some('#')) => {
                self.advance();
                self.word();
            }
            ("b" | "c", Some('"')) => self.string(),
            ("b", Some('\'')) => self.quote(),
            _ => self.push(TokenKind::Word(word)),
        }
    }

    /// Returns whether the next characters are one or more `#` and then a `"`.
    fn raw_string_follows(&self) -> bool {
        self.chars[self.position..].iter().find(|&&c| c != '#') == Some(&'"')
    }
}
