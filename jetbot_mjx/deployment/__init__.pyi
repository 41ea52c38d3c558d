from .drive_comparison import compare_drive as compare_drive
from .drive_comparison import summarize_drive as summarize_drive
from .exporters import read_exported as read_exported
from .policy_export import export_policy as export_policy
from .policy_export import summarize_export as summarize_export
from .web_page import summarize_web_page as summarize_web_page
from .web_page import write_web_page as write_web_page
