"""The schema of values that users give: units, ranges, records, validated calls, and their errors."""
