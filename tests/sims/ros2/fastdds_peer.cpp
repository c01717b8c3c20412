// A node on Fast DDS, the default middleware of ROS 2. Sends a scan at 20 Hz, and prints the twists that it receives in
// hexadecimal.
//
//     fastdds_peer DOMAIN SCAN_IN_HEXADECIMAL

#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <iomanip>
#include <iostream>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<std::uint8_t>;

// A type whose samples are serialized messages.
class Raw : public TopicDataType {
public:
    explicit Raw(const char* name) {
        setName(name);
        m_typeSize = 1 << 16;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* data, SerializedPayload_t* payload) override {
        const auto& bytes = *static_cast<Bytes*>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = static_cast<std::uint32_t>(bytes.size());
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<std::uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

Bytes from_hexadecimal(const std::string& text) {
    Bytes bytes;
    for (std::size_t at = 0; at < text.size(); at += 2) {
        bytes.push_back(static_cast<std::uint8_t>(std::stoi(text.substr(at, 2), nullptr, 16)));
    }
    return bytes;
}

int main(int, char** arguments) {
    auto* participant = DomainParticipantFactory::get_instance()->create_participant(
        static_cast<std::uint32_t>(std::stoi(arguments[1])), PARTICIPANT_QOS_DEFAULT);
    TypeSupport scan_type(new Raw("sensor_msgs::msg::dds_::LaserScan_"));
    TypeSupport twist_type(new Raw("geometry_msgs::msg::dds_::Twist_"));
    scan_type.register_type(participant);
    twist_type.register_type(participant);
    auto* scans = participant->create_topic("rt/scan", scan_type.get_type_name(), TOPIC_QOS_DEFAULT);
    auto* twists = participant->create_topic("rt/cmd_vel", twist_type.get_type_name(), TOPIC_QOS_DEFAULT);

    // ROS 2's quality of service for sensor data.
    DataWriterQos sensor = DATAWRITER_QOS_DEFAULT;
    sensor.reliability().kind = BEST_EFFORT_RELIABILITY_QOS;
    auto* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(scans, sensor);
    DataReaderQos command = DATAREADER_QOS_DEFAULT;
    command.reliability().kind = RELIABLE_RELIABILITY_QOS;
    auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(twists, command);

    Bytes scan = from_hexadecimal(arguments[2]);
    Bytes twist;
    SampleInfo info;
    std::cout << "up" << std::endl;
    for (;;) {
        writer->write(&scan);
        while (reader->take_next_sample(&twist, &info) == ReturnCode_t::RETCODE_OK) {
            for (auto byte : twist) {
                std::cout << std::hex << std::setw(2) << std::setfill('0') << static_cast<int>(byte);
            }
            std::cout << std::endl;
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
}
