// Peer that uses another vendor's DDS, Fast DDS: publishes and subscribes to std_msgs/String like ROS 2, and prints the
// number of received messages and the last one, a line of JSON ten times a second, until its input is closed.
// peer NAME OTHER: publishes on rt/NAME/String, subscribes to rt/OTHER/String. The domain is ROS_DOMAIN_ID.
#include <atomic>
#include <cstdlib>
#include <functional>
#include <iostream>
#include <mutex>
#include <string>

#include <poll.h>

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

// std_msgs/String: one field, `data`.
class StringType : public TopicDataType {
 public:
  StringType() {
    setName("std_msgs::msg::dds_::String_");
    m_typeSize = 1 << 16;
    m_isGetKeyDefined = false;
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
    eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
    payload->encapsulation = cdr.endianness() == eprosima::fastcdr::Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
    cdr.serialize_encapsulation();
    cdr << *static_cast<std::string*>(data);
    payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
    return true;
  }
  bool deserialize(SerializedPayload_t* payload, void* data) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
    eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
    cdr.read_encapsulation();
    cdr >> *static_cast<std::string*>(data);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<uint32_t>(static_cast<std::string*>(data)->size() + 16); };
  }
  void* createData() override { return new std::string; }
  void deleteData(void* data) override { delete static_cast<std::string*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

class Received : public DataReaderListener {
 public:
  void on_data_available(DataReader* reader) override {
    std::string data;
    SampleInfo info;
    while (reader->take_next_sample(&data, &info) == ReturnCode_t::RETCODE_OK)
      if (info.valid_data) {
        std::lock_guard<std::mutex> lock(mutex);
        text = data;
        ++count;
      }
  }
  std::mutex mutex;
  std::string text;
  int count = 0;
};

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  const char* domain = std::getenv("ROS_DOMAIN_ID");
  auto* participant = DomainParticipantFactory::get_instance()->create_participant(
      domain ? std::atoi(domain) : 0, PARTICIPANT_QOS_DEFAULT);
  TypeSupport type(new StringType);
  type.register_type(participant);
  auto topic = [&](const char* name) {
    return participant->create_topic(std::string("rt/") + name + "/String", type.get_type_name(), TOPIC_QOS_DEFAULT);
  };
  auto* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)
                     ->create_datawriter(topic(argv[1]), DATAWRITER_QOS_DEFAULT);
  DataReaderQos reliable = DATAREADER_QOS_DEFAULT;
  reliable.reliability().kind = RELIABLE_RELIABILITY_QOS;
  Received received;
  participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic(argv[2]), reliable, &received);
  std::string text = "Straße, 画像";
  std::cout << "ready" << std::endl;
  for (pollfd input{0, POLLIN, 0}; poll(&input, 1, 100) == 0;) {
    writer->write(&text);
    std::lock_guard<std::mutex> lock(received.mutex);
    std::cout << "{\"count\": " << received.count << ", \"text\": \"" << received.text << "\"}" << std::endl;
  }
  std::_Exit(0);
}
