//! Parameter sets from CSV files.

use csv::{ReaderBuilder, StringRecord};
use perturb_protocol::Version;

use super::{Context, Contexts, MAX_CONTEXTS, TestSet};
use crate::value_error::{ValueError, require};

/// Maximum number of characters of a line that an error message quotes.
const MAX_QUOTED_LETTERS: usize = 60;

/// Makes a set called `name` from a CSV file. Its header has the names of parameters, and each further row has their
/// values in one context. Blank lines are ignored.
///
/// # Errors
/// [`ValueError`] with the number of the faulty line.
pub fn set_of_csv(name: &str, version: Version, content: &[u8]) -> Result<TestSet, ValueError> {
    let text = text(name, content)?.replace("\r\n", "\n");
    let lines = text.split(['\n', '\r']).zip(1..); // programs for old Macs end lines by \r alone
    let mut lines = lines.filter(|(line, _)| !line.trim().is_empty());
    let expected = "a header of parameters, then a row for each context";
    let (first, number) = lines.next().ok_or_else(|| ValueError::new(name, "empty", expected))?;
    let header = header(&format!("{name}: the header in line {number}"), first)?;
    let mut contexts = Vec::new();
    for (line, number) in lines {
        let what = format!("{name}: line {number}");
        require(contexts.len() < MAX_CONTEXTS, &what, "one row more", format!("the end, after {MAX_CONTEXTS} rows"))?;
        let values = fields(&what, line)?;
        if values.len() != header.len() {
            let got = format!("`{}` with {} values", quoted(line), values.len());
            let expected = format!("as long as the header, {}; numbers have a decimal point", header.len());
            return Err(ValueError::new(what, got, expected));
        }
        contexts.push(context(name, number, &header, &values)?);
    }
    require(!contexts.is_empty(), name, "0 rows", format!("1 to {MAX_CONTEXTS} rows of parameters"))?;
    Ok(TestSet { name: name.into(), version, contexts: Contexts::Listed(contexts) })
}

/// Decodes the file as UTF-8, without its byte order mark.
fn text<'a>(name: &str, content: &'a [u8]) -> Result<&'a str, ValueError> {
    let content = content.strip_prefix(b"\xef\xbb\xbf").unwrap_or(content);
    std::str::from_utf8(content).map_err(|error| {
        let got = match content {
            [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => "UTF-16 text".to_owned(),
            _ => format!("not UTF-8 ({error})"),
        };
        ValueError::new(name, got, "CSV as UTF-8 text: save it as `CSV UTF-8`")
    })
}

/// Parses the header and returns the names of the columns. `what` describes the header in error messages.
fn header(what: &str, line: &str) -> Result<Vec<String>, ValueError> {
    if let Some(separator) = [';', '\t'].into_iter().find(|&separator| line.contains(separator)) {
        let got = format!("`{}`, with columns separated by {separator:?}", quoted(line));
        return Err(ValueError::new(what, got, "names separated by commas; numbers have a decimal point"));
    }
    let names: Vec<String> = fields(what, line)?.iter().map(|name| name.trim().to_owned()).collect();
    for (index, name) in names.iter().enumerate() {
        let column = format!("`{}`, whose column {} has no name", quoted(line), index + 1);
        let remedy = match index {
            0 => "a name for each column: leave out the index, in pandas with `to_csv(index=False)`",
            _ => "a name for each column: leave out the comma at the end of lines",
        };
        require(!name.is_empty(), what, column, remedy)?;
        let is_new = !names[..index].contains(name);
        require(is_new, what, format!("`{}`, with the column {name} twice", quoted(line)), "different names")?;
    }
    Ok(names)
}

/// Parses a row into a context, the values of the parameters by name. `values` must have the same length as `header`.
fn context(name: &str, line: u64, header: &[String], values: &StringRecord) -> Result<Context, ValueError> {
    let value = |(parameter, text): (&String, &str)| {
        let number = text.trim().parse::<f64>().ok().filter(|number| number.is_finite());
        let what = || format!("{name}: {parameter} in line {line}");
        let refused = || ValueError::new(what(), format!("`{}`", quoted(text)), "a number with a decimal point");
        Ok((parameter.clone(), number.ok_or_else(refused)?))
    };
    header.iter().zip(values).map(value).collect()
}

/// Splits a line into its fields, which may be in quotation marks.
fn fields(what: &str, line: &str) -> Result<StringRecord, ValueError> {
    let is_complete = line.matches('"').count().is_multiple_of(2);
    let got = format!("`{}`, with a quoted value that does not end", quoted(line));
    require(is_complete, what, got, "values within their line")?;
    let mut fields = StringRecord::new();
    let mut reader = ReaderBuilder::new().has_headers(false).from_reader(line.as_bytes());
    let read = reader.read_record(&mut fields);
    read.map_err(|error| ValueError::new(what, format!("not understood ({error})"), "values separated by commas"))?;
    Ok(fields)
}

/// Shortens a text for an error message.
fn quoted(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTED_LETTERS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    fn listed(text: &str) -> Vec<Context> {
        set_of_csv("rows", Version::R, text.as_bytes()).unwrap().listed()
    }

    fn rows(values: &[(f64, f64)]) -> Vec<Context> {
        let row = |&(length, mass)| Context::from([("length".into(), length), ("mass".into(), mass)]);
        values.iter().map(row).collect()
    }

    #[rstest]
    #[case::plain("length,mass\n0.5,0.1\n1,0.2\n")]
    #[case::spaces("length, mass\n0.5, 0.1\n1 ,0.2\n")]
    #[case::crlf("length,mass\r\n0.5,0.1\r\n1,0.2\r\n")]
    #[case::byte_order_mark("\u{feff}length,mass\n0.5,0.1\n1,0.2")]
    #[case::quoted("\"length\",\"mass\"\n\"0.5\",\"0.1\"\n\"1\",\"0.2\"")]
    #[case::cr("length,mass\r0.5,0.1\r1,0.2\r")]
    #[case::mixed("length,mass\n0.5,0.1\r1,0.2\r\n")]
    #[case::blank_lines("\nlength,mass\n\n0.5,0.1\n  \n\n+1e0,.2\n\n")]
    fn rows_of_a_file_are_contexts(#[case] text: &str) {
        assert_eq!(listed(text), rows(&[(0.5, 0.1), (1.0, 0.2)]));
    }

    #[rstest]
    #[case("length\n", "0 rows")]
    #[case("", "rows is empty")]
    #[case("length\nx\n", "length in line 2 is `x`")]
    #[case("length\n0.3\n\n\n0.4\nnought\n", "length in line 6 is `nought`")]
    #[case("\n\nlength,mass\n\n0.3,\n", "mass in line 5 is ``")]
    #[case("length\nnan\n", "line 2 is `nan`")]
    #[case("length\n1e400\n", "line 2 is `1e400`")]
    #[case("a,a\n1,2\n", "with the column a twice")]
    #[case("a,b\n1\n", "line 2 is `1` with 1 values, but must be as long as the header, 2")]
    #[case("length\n0,3\n", "line 2 is `0,3` with 2 values, but must be as long as the header, 1; numbers have")]
    #[case("length\n\"1,000\"\n", "line 2 is `1,000`, but must be a number with a decimal point")]
    #[case("length;mass\n0,3;0,1\n", "with columns separated by ';', but must be names separated by commas")]
    #[case(",length\n0,0.3\n", "column 1 has no name, but must be a name for each column: leave out the index")]
    #[case("length\r\n0.3\r\n\r\nnought\r\n", "length in line 4 is `nought`")]
    #[case(
        "length\n\"0.3\n\"\n",
        "line 2 is `\"0.3`, with a quoted value that does not end, but must be values within"
    )]
    #[case("\"len\ngth\"\n0.3\n", "the header in line 1 is `\"len`, with a quoted value that does not end")]
    #[case("length,\n0.3,\n", "column 2 has no name, but must be a name for each column: leave out the comma")]
    fn a_fault_is_named_with_its_line_and_cause(#[case] text: &str, #[case] part: &str) {
        let error = set_of_csv("rows", Version::R, text.as_bytes()).unwrap_err().to_string();
        assert!(error.contains(part), "{text}: {error}");
    }

    #[test]
    fn other_encodings_are_named() {
        for (content, part) in [(&b"\xff\xfel\0"[..], "is UTF-16 text"), (b"l\xe4nge\n1\n", "is not UTF-8")] {
            let error = set_of_csv("rows", Version::R, content).unwrap_err().to_string();
            assert!(error.contains(part) && error.contains("save it as `CSV UTF-8`"), "{error}");
        }
    }

    #[test]
    fn no_more_rows_are_read_than_a_set_may_have() {
        let text = format!("length\n{}", "1\n".repeat(MAX_CONTEXTS + 1));
        let error = set_of_csv("rows", Version::R, text.as_bytes()).unwrap_err().to_string();
        assert!(error.contains(&format!("line {} is one row more", MAX_CONTEXTS + 2)), "{error}");
    }
}
