//! What is wrong with a scene, shown on its line.

use miette::{Diagnostic, LabeledSpan, NamedSource};
use std::{ops::Range, sync::Arc};
use thiserror::Error;

/// One fault of a scene file (and the others found with it), with its place and a suggestion.
///
/// As a miette diagnostic it prints the line; as `Display` it is one sentence with file and line.
#[derive(Debug, Error, Diagnostic)]
#[error("{sentence}")]
pub struct SceneError {
    sentence: String,
    #[help]
    help: Option<String>,
    #[source_code]
    // behind a pointer, so that a `Result` of it stays small
    text: Option<Arc<NamedSource<Arc<str>>>>,
    #[label(collection)]
    labels: Vec<LabeledSpan>,
    #[related]
    others: Vec<SceneError>,
}

/// A fault before it is tied to a file: what, where in the text, and what to do.
#[derive(Clone, Debug)]
pub(crate) struct Fault {
    /// what is wrong: one sentence
    pub message: String,
    /// bytes of the text it stands in
    pub span: Option<Range<usize>>,
    /// a few words beside the place
    pub label: String,
    /// what to do
    pub help: Option<String>,
}

/// A scene file's name and text, for messages.
#[derive(Clone, Debug)]
pub(crate) struct Source {
    pub name: String,
    pub text: Arc<str>,
}

impl Source {
    /// The error of these faults; the first leads.
    pub fn error(&self, faults: Vec<Fault>) -> SceneError {
        let mut errors = faults.into_iter().map(|fault| {
            let place = match &fault.span {
                Some(span) => format!("{}:{}", self.name, self.text[..span.start.min(self.text.len())].matches('\n').count() + 1),
                None => self.name.clone(),
            };
            SceneError {
                sentence: format!("{place}: {}", fault.message),
                help: fault.help,
                labels: fault.span.map(|span| LabeledSpan::new_with_span(Some(fault.label), span)).into_iter().collect(),
                text: Some(Arc::new(NamedSource::new(&self.name, self.text.clone()))),
                others: Vec::new(),
            }
        });
        let mut first = errors.next().expect("an error is made of at least one fault");
        first.others = errors.collect();
        first
    }
}

impl SceneError {
    /// A fault that stands on no line.
    pub fn sentence(sentence: impl Into<String>, help: Option<String>) -> Self {
        Self { sentence: sentence.into(), help, text: None, labels: Vec::new(), others: Vec::new() }
    }

    /// What to do, if anything is known.
    pub fn advice(&self) -> Option<&str> {
        self.help.as_deref()
    }

    /// The faults found beside the first.
    pub fn others(&self) -> &[SceneError] {
        &self.others
    }

    /// The marked part of the scene's text, if the fault stands on a line.
    pub fn marked(&self) -> Option<&str> {
        let (label, text) = (self.labels.first()?, self.text.as_ref()?);
        text.inner().get(label.offset()..label.offset() + label.len())
    }
}
