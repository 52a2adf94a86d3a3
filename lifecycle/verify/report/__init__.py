"""A verdict written down: text for people, JSON, JUnit and SARIF for machines."""

from lifecycle.verify.report.json_document import to_json
from lifecycle.verify.report.junit import to_junit
from lifecycle.verify.report.sarif import to_sarif
from lifecycle.verify.report.text import render_text

__all__ = ["render_text", "to_json", "to_junit", "to_sarif"]
