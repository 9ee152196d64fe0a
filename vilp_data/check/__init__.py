"""The doctor for logs and datasets: pure findings, what gathers them (`log`, `dataset`), what shows them (`text`, `page`)."""
