"""A log written again by the mcap package: another compression, no chunks, fewer topics, edited messages."""

from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer


def copy_with(path, target, keep=None, edit=None, **options) -> Path:
    """Copy a log.

    Args:
        keep: called with a topic; False leaves it out.
        edit: called with (topic, log time, data bytes); returns the data to write.
        options: of mcap.writer.Writer.
    """
    with open(path, "rb") as source, open(target, "wb") as out:
        reader = make_reader(source)
        writer = Writer(out, **options)
        writer.start()
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for one in reader.iter_metadata():
            writer.add_metadata(one.name, one.metadata)
        ids = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if keep is not None and not keep(channel.topic):
                continue
            if channel.topic not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data if edit is None else edit(channel.topic, message.log_time, message.data)
            writer.add_message(ids[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return Path(target)
