//! The page's files, built into the program: nothing is read at run time and nothing comes from elsewhere.

/// A file of the page.
pub struct Asset {
    /// path in its address
    pub path: &'static str,
    /// MIME type
    pub content_type: &'static str,
    /// its text
    pub content: &'static str,
}

macro_rules! asset {
    ($path:literal, $file:literal, $content_type:literal) => {
        Asset { path: $path, content_type: $content_type, content: include_str!(concat!("page/", $file)) }
    };
}

/// All of them.
pub static FILES: &[Asset] = &[
    asset!("/", "index.html", "text/html; charset=utf-8"),
    asset!("/style.css", "style.css", "text/css; charset=utf-8"),
    asset!("/icon.svg", "icon.svg", "image/svg+xml"),
    asset!("/main.js", "main.js", "text/javascript; charset=utf-8"),
    asset!("/link.js", "link.js", "text/javascript; charset=utf-8"),
    asset!("/geometry.js", "geometry.js", "text/javascript; charset=utf-8"),
    asset!("/views.js", "views.js", "text/javascript; charset=utf-8"),
    asset!("/mouse.js", "mouse.js", "text/javascript; charset=utf-8"),
    asset!("/tool.js", "tool.js", "text/javascript; charset=utf-8"),
    asset!("/picture.js", "picture.js", "text/javascript; charset=utf-8"),
    asset!("/transfer.js", "transfer.js", "text/javascript; charset=utf-8"),
    asset!("/breath.js", "breath.js", "text/javascript; charset=utf-8"),
    asset!("/charts.js", "charts.js", "text/javascript; charset=utf-8"),
    asset!("/services.js", "services.js", "text/javascript; charset=utf-8"),
];
