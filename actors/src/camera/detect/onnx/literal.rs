//! Literals of Python and JSON, the notations in which exporters write metadata.

use std::iter::Peekable;
use std::str::Chars;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Literal {
    /// Text in quotes, without escapes.
    Text(String),
    /// Anything without quotes: a number, `True`, `null`.
    Word(String),
    List(Vec<Literal>),
    Map(Vec<(Literal, Literal)>),
}

impl Literal {
    /// The whole number, with or without quotes.
    pub(super) fn number(&self) -> Option<usize> {
        match self {
            Self::Text(text) | Self::Word(text) => text.parse().ok(),
            Self::List(_) | Self::Map(_) => None,
        }
    }
}

/// Maximum nesting of lists and maps.
const MAX_DEPTH: usize = 8;

/// Reads one literal.
///
/// # Errors
/// Returns the fault.
pub(super) fn parse(text: &str) -> Result<Literal, String> {
    let mut parser = Parser(text.chars().peekable());
    let literal = parser.literal(MAX_DEPTH)?;
    match parser.next_mark() {
        None => Ok(literal),
        Some(rest) => Err(format!("`{rest}` follows the end")),
    }
}

struct Parser<'a>(Peekable<Chars<'a>>);

impl Parser<'_> {
    fn literal(&mut self, depth: usize) -> Result<Literal, String> {
        if depth == 0 {
            return Err("lists are nested too deeply".into());
        }
        match self.next_mark() {
            Some('{') => Ok(Literal::Map(self.entries('}', |parser| {
                let key = parser.literal(depth - 1)?;
                match parser.next_mark() {
                    Some(':') => Ok((key, parser.literal(depth - 1)?)),
                    found => Err(unexpected(found, "a colon after a key")),
                }
            })?)),
            Some('[') => Ok(Literal::List(
                self.entries(']', |parser| parser.literal(depth - 1))?,
            )),
            Some('(') => Ok(Literal::List(
                self.entries(')', |parser| parser.literal(depth - 1))?,
            )),
            Some(quote @ ('\'' | '"')) => self.text(quote).map(Literal::Text),
            Some(first) if first.is_alphanumeric() || matches!(first, '+' | '-' | '.' | '_') => {
                self.word(first)
            }
            found => Err(unexpected(found, "a value")),
        }
    }

    /// Comma-separated entries; a trailing comma is allowed.
    fn entries<T>(
        &mut self,
        end: char,
        mut entry: impl FnMut(&mut Self) -> Result<T, String>,
    ) -> Result<Vec<T>, String> {
        let mut entries = Vec::new();
        loop {
            self.skip_blanks();
            if self.0.next_if_eq(&end).is_some() {
                return Ok(entries);
            }
            entries.push(entry(self)?);
            match self.next_mark() {
                Some(',') => {}
                Some(mark) if mark == end => return Ok(entries),
                found => return Err(unexpected(found, "a comma or the end of a list")),
            }
        }
    }

    /// A word, or text behind a prefix of Python, such as `u'person'`.
    fn word(&mut self, first: char) -> Result<Literal, String> {
        let mut word = String::from(first);
        while let Some(next) = self
            .0
            .next_if(|c| c.is_alphanumeric() || matches!(c, '+' | '-' | '.' | '_'))
        {
            word.push(next);
        }
        match self.0.next_if(|c| matches!(c, '\'' | '"')) {
            Some(quote) if matches!(&*word, "u" | "U" | "b" | "B") => {
                self.text(quote).map(Literal::Text)
            }
            Some(_) => Err(format!("{word} is before a quote")),
            None => Ok(Literal::Word(word)),
        }
    }

    /// The rest of a text up to its quote.
    fn text(&mut self, quote: char) -> Result<String, String> {
        let mut text = Vec::new();
        loop {
            match self.0.next().ok_or("a quote is missing")? {
                c if c == quote => break,
                '\\' => self.escape(&mut text)?,
                c => text.extend_from_slice(c.encode_utf16(&mut [0; 2])),
            }
        }
        String::from_utf16(&text).map_err(|_| "an escape is half a character".into())
    }

    fn escape(&mut self, text: &mut Vec<u16>) -> Result<(), String> {
        let escaped = self.0.next().ok_or("a quote is missing")?;
        let character = match escaped {
            // JSON writes a character above U+FFFF as two escapes.
            'u' => {
                text.push(self.code(4)? as u16);
                return Ok(());
            }
            'x' => char::from_u32(self.code(2)?),
            'U' => char::from_u32(self.code(8)?),
            'n' => Some('\n'),
            't' => Some('\t'),
            'r' => Some('\r'),
            'b' => Some('\u{8}'),
            'f' => Some('\u{c}'),
            '\'' | '"' | '\\' | '/' => Some(escaped),
            _ => None,
        };
        let c = character.ok_or_else(|| format!("\\{escaped} is no escape"))?;
        text.extend_from_slice(c.encode_utf16(&mut [0; 2]));
        Ok(())
    }

    /// A number of that many hexadecimal digits.
    fn code(&mut self, digits: usize) -> Result<u32, String> {
        let mut code = 0;
        for _ in 0..digits {
            let digit = self.0.next().and_then(|c| c.to_digit(16));
            code = code << 4 | digit.ok_or("an escape is cut off")?;
        }
        Ok(code)
    }

    fn skip_blanks(&mut self) {
        while self.0.next_if(|c| c.is_whitespace()).is_some() {}
    }

    /// The next character that is not blank.
    fn next_mark(&mut self) -> Option<char> {
        self.skip_blanks();
        self.0.next()
    }
}

fn unexpected(found: Option<char>, expected: &str) -> String {
    match found {
        Some(found) => format!("`{found}` in place of {expected}"),
        None => format!("{expected} is missing"),
    }
}
