"""The smallest exam that can be made, for tests."""

SMALL = (
    "mode=exam", "exam.mix.num_cases=2", "exam.mix.shares={none: 0.5, faint: 0, one: 0.5, several: 0, outside: 0}",
    "exam.reference.programs=[[levels]]", "exam.reference.file_s=12", "exam.field.programs=[[levels],[levels]]",
    "exam.field.file_s=8", "exam.withheld.programs=[[levels]]", "exam.withheld.file_s=10",
)  # fmt: skip
"""Overrides of the command: two cases of some seconds, one of them without a gap."""
