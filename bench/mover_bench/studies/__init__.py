"""Known rooms rebuilt and measured: sets, jobs, tables and pictures."""
