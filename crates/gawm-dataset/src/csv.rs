//! CSV as spreadsheets write it (RFC 4180), with the line that each record begins in.

/// A record: the line it begins in, from 1, and its cells.
pub type Record = (u64, Vec<String>);

/// Returns the records of a table; lines without anything are none.
///
/// Cells are separated by commas, or by semicolons or tabs where the first line has these and no comma. A byte order
/// mark at the beginning is passed over.
///
/// ```
/// let records = gawm_dataset::csv::parse("log,task\na.mcap,\"stack, then \"\"wave\"\"\"\n").unwrap();
/// assert_eq!(records[1], (2, vec!["a.mcap".to_owned(), "stack, then \"wave\"".to_owned()]));
/// ```
///
/// # Errors
/// The line, and what is wrong in it.
pub fn parse(text: &str) -> Result<Vec<Record>, (u64, String)> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let header = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
    let delimiter = [',', ';', '\t'].into_iter().find(|delimiter| header.contains(*delimiter)).unwrap_or(',');
    let mut records: Vec<Record> = Vec::new();
    let mut reader = Reader { text, line: 1, delimiter };
    while !reader.text.is_empty() {
        let line = reader.line;
        let cells = reader.record()?;
        if cells.iter().any(|cell| !cell.trim().is_empty()) {
            records.push((line, cells));
        }
    }
    Ok(records)
}

/// Returns a cell as it is written into a table.
pub(crate) fn quoted(cell: &str) -> String {
    let is_plain = !cell.contains([',', ';', '\t', '"', '\n', '\r']) && cell.trim() == cell;
    if is_plain { cell.to_owned() } else { format!("\"{}\"", cell.replace('"', "\"\"")) }
}

struct Reader<'a> {
    text: &'a str,
    line: u64,
    delimiter: char,
}

impl Reader<'_> {
    fn record(&mut self) -> Result<Vec<String>, (u64, String)> {
        let mut cells = Vec::new();
        loop {
            cells.push(if self.text.starts_with('"') { self.quoted_cell()? } else { self.plain_cell()? });
            match self.take() {
                Some(c) if c == self.delimiter => {}
                None | Some('\n') => return Ok(cells),
                // A line end of two characters.
                Some('\r') if self.text.starts_with('\n') => {
                    self.take();
                    return Ok(cells);
                }
                Some('\r') => return Ok(cells),
                Some(c) => {
                    return Err((
                        self.line,
                        format!("expected a separator after the closing quote, got {c:?}"),
                    ));
                }
            }
        }
    }

    fn plain_cell(&mut self) -> Result<String, (u64, String)> {
        let end = self.text.find([self.delimiter, '\n', '\r']).unwrap_or(self.text.len());
        let (cell, rest) = self.text.split_at(end);
        if cell.contains('"') {
            let detail =
                format!("a quote inside of {cell:?}: expected the whole cell in quotes, inner ones twice");
            return Err((self.line, detail));
        }
        self.text = rest;
        Ok(cell.to_owned())
    }

    fn quoted_cell(&mut self) -> Result<String, (u64, String)> {
        let begin = self.line;
        let mut cell = String::new();
        self.take();
        loop {
            match self.take() {
                Some('"') if self.text.starts_with('"') => {
                    self.take();
                    cell.push('"');
                }
                Some('"') => return Ok(cell),
                Some(c) => cell.push(c),
                None => return Err((begin, "a quote is opened and never closed".to_owned())),
            }
        }
    }

    fn take(&mut self) -> Option<char> {
        let c = self.text.chars().next()?;
        self.text = &self.text[c.len_utf8()..];
        self.line += u64::from(c == '\n');
        Some(c)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(text: &str, expected: &[(u64, &[&str])]) {
        let records = parse(text).unwrap();
        let got: Vec<(u64, Vec<&str>)> =
            records.iter().map(|(line, cells)| (*line, cells.iter().map(String::as_str).collect())).collect();
        let expected: Vec<(u64, Vec<&str>)> = expected.iter().map(|(line, c)| (*line, c.to_vec())).collect();
        assert_eq!(got, expected, "{text:?}");
    }

    #[test]
    fn tables_of_spreadsheets_are_read() {
        check("a,b\n1,2", &[(1, &["a", "b"]), (2, &["1", "2"])]);
        check("a;b\r\n1;2,5\r\n", &[(1, &["a", "b"]), (2, &["1", "2,5"])]);
        check("a\tb\n\n \t\n1\t\n", &[(1, &["a", "b"]), (4, &["1", ""])]);
        check(
            "a,b\n\"x \"\"y\"\"\nz\",2\n3,4\n",
            &[(1, &["a", "b"]), (2, &["x \"y\"\nz", "2"]), (4, &["3", "4"])],
        );
        check("\u{feff}a,b\n", &[(1, &["a", "b"])]);
        check("a\n\u{e9},\n", &[(1, &["a"]), (2, &["\u{e9}", ""])]);
        check("", &[]);
    }

    #[test]
    fn broken_quotes_name_their_line() {
        let error = |text: &str| parse(text).unwrap_err();
        assert_eq!(error("a,b\n\"1,2\n3\n").0, 2);
        assert_eq!(error("a,b\n1,x\"y\"\n").0, 2);
        assert!(error("a\n\"x\"y\n").1.contains("'y'"));
    }

    #[test]
    fn what_is_written_is_read_again() {
        for cell in ["plain", "a, b", "x \"y\"", "two\nlines", " space ", "a;b", "\r", ""] {
            let text = format!("{},x\n", quoted(cell));
            assert_eq!(parse(&text).unwrap()[0].1[0], cell, "{text:?}");
        }
    }
}
